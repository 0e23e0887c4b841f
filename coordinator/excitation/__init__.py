"""Motions chosen by their information: plan, single joint, multisine, D-optimal."""
