"""What speaks for an object and against it: chance, detections and misses, size and motion."""
