"""Judges for each label of a session whether it is the name of one object, a class of several objects, or the label of
things that move. A separate process solves the whole drive for this."""
