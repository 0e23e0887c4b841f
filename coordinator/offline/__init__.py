"""Other people's robots: a URDF and recorded joint torques in, what they say of the dynamics out."""
