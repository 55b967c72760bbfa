"""A session turns messages into a map and a result. `live.mapper` makes the map, and `live.adapters` bring the messages."""
