"""Rigid-body and drive models that torques are explained by."""
