"""The published interface of a module: keys, messages, their bytes, and the transports that carry them."""
