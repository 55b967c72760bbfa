"""What each label of a session is: the name of one object, a class of several, or of things that move."""
