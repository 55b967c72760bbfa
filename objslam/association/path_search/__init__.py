"""Find the most likely path of a robot through a map of landmarks, when each ray may belong to any landmark. It moves whole
visits of the robot from landmarks to their neighbours, which no small change does."""
