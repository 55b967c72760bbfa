"""Live: the map while the robot drives. The session knows no middleware; an adapter brings the messages, a file each."""
