"""Association: which ray belongs to which object."""
