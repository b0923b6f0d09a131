"""Plan -> Frame: the shadow algorithms, each filling the visibility of one light for the points of a geometry buffer.

May import the floor ``terrain``. Beside the rooms lie what all algorithms share (``plan``, ``passes``, ``attached``), the
smallest algorithm (``planar``), and what runs them: ``registry``,
``visibility`` and ``render``.
"""
