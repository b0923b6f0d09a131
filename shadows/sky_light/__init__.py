"""Light of the whole sky on a map's ground, with the shadows that ground and buildings cast in it from every direction."""
