"""What stands in for hebi-py without modules: the part that the driver uses, over simulated modules."""
