"""Compute cast shadows: the shadow algorithms, and the code that runs them by a plan to render a frame.

Each algorithm fills the visibility of one light (1: lit, 0: in shadow) at the points of a geometry buffer.

- Each folder holds one algorithm, or one family of algorithms.
- ``algorithm`` defines the record that declares an algorithm, ``algorithm_settings`` the base classes of settings, and
  ``requirements`` the requirements that an algorithm may refuse.
- ``passes``, ``work``, ``attached_shadow`` and ``area_light`` hold code that all algorithms share.
- ``planar`` and ``none`` are the smallest algorithms.
- ``registry``, ``plan``, ``visibility`` and ``render`` list the algorithms and run them.
"""
