"""Sampled signals: filters, clock maps, torque-term columns."""
