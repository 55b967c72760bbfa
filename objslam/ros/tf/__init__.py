"""Look up transforms between coordinate frames in a recording or live session. `ros.messages` decodes the messages of tf."""
