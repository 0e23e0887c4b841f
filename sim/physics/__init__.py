"""Rigid multibody dynamics, by PyBullet and by compiled kernels."""
