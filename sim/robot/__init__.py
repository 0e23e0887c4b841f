"""Robot files and the robots they describe."""
