"""The kinematic chain assembled from estimates of joint and observer pairs."""
