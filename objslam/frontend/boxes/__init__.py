"""Find boxes of a log that show no thing of their own. `bearings` finds the boxes that are wrong by themselves, such as
those with a low score."""
