"""One connected robot: discovery, commands, replies, missing rows."""
