"""Plan -> Frame: the shadow algorithms. Each fills the visibility of one light for the points of a geometry buffer.

- The folders hold one algorithm, or one family of algorithms, each.
- ``algorithm`` defines the record that declares an algorithm; ``passes``, ``work``, ``attached`` and ``area_light`` hold code that
  all algorithms share.
- ``planar`` and ``none`` are the smallest algorithms.
- ``registry``, ``plan``, ``visibility`` and ``render`` list the algorithms and run them.
"""
