"""Graphs over several maps. A drive is solved in an older map, and the frames of many maps are solved together."""
