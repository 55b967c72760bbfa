"""Explore a log without a localisation, where nobody knows which box shows which object."""
