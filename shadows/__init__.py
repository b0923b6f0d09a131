"""Plan -> Frame: the shadow algorithms, each filling the visibility of one light for the points of a geometry buffer.

Beside the folders lies what all algorithms share (``algorithm``: what one is; ``passes``,
``work``, ``attached``, ``area_light``), the smallest two (``planar``, ``none``), and what runs them: ``registry``, ``plan``,
``visibility`` and ``render``.
"""
