"""What one watches while the robot measures itself: a Rerun recording, live and as a file."""
