void main() { if (is_outside_cube()) discard; }
