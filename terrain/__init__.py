"""The world, as facts: Level -> Scene -> Descriptor, and what is seen of it. No decision about shadows.

The lowest floor: it imports no other. Beside the rooms lie the leaves (``errors``, ``compiled``, ``cache``, ``whole_files``), which
everything may import, and the spine: ``scene`` with its ``scene_objects`` and ``lights``, ``shading``, and ``describe``, which is
above all rooms.
"""
