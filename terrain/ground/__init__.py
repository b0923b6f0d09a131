"""The ground: heights read or made, its surface in a frame, its decimation, its imagery, its horizons."""
