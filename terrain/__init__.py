"""Facts about the world: levels, scenes, descriptors and visible surfaces. Decides nothing about shadows.

This is the lowest layer. It imports no other layer of Skugga.

- A level is read into a scene. A scene and a view give a descriptor.
- The modules ``errors``, ``compiled``, ``cache`` and ``atomic_files`` may be imported by every module.
- The modules ``scene`` (with ``scene_objects`` and ``lights``), ``shading`` and ``describe`` combine the packages. ``describe`` is
  the topmost one.
"""
