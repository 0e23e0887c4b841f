"""The heat of a motor: winding, housing and body as a chain of heat capacities to the air; copper."""

AMBIENT_C = 25.0
# Of winding, housing and body; and from each to the next, the body's to the air. Published constants.
CAPACITIES_J_K = (0.367, 16.6, 1250.0)
RESISTANCES_K_W = (4.626, 1.0, 8.0)
# Copper's resistance grows by this share for every kelvin above the ambient, at which it is catalogued.
COPPER_PER_K = 0.00393
