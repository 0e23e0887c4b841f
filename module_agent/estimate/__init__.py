"""The module's own estimate of the joint that moves it."""
