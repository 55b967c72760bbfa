"""Find boxes of a log that show no thing of their own. Boxes that are wrong in themselves are those of `bearings`."""
