"""The facts that choices are made from: the type ``Descriptor``, and what measures its parts on a scene and a view."""
