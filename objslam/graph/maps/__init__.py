"""Graphs with an older map: a drive is solved in the map, offline and live."""
