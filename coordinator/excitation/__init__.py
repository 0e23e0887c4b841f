"""Motions chosen for what they tell: plan, single joint, multisine, D-optimal."""
