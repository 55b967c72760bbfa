"""Look up transforms between frames of a recording or a live session. `ros.messages` decodes the transform messages."""
