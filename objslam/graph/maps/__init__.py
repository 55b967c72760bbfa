"""Graphs with an older map. A drive is solved in the map, offline or live."""
