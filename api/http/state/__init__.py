"""What a running service holds: its levels and archives, tiles that were encoded, suns that clients asked for, its metrics."""
