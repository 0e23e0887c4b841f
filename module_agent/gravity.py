"""Gravity's size where nobody has measured it: anywhere on the ground of the Earth."""

# From 9.764 (Huascaran) to 9.834 m/s^2 (the Arctic Ocean): Hirt et al., New ultrahigh-resolution picture of
# Earth's gravity field, Geophys. Res. Lett. 40, 2013. Taken as a uniform distribution: its mean, its sigma.
GRAVITY_M_S2, GRAVITY_SIGMA_M_S2 = 9.80, 0.02
