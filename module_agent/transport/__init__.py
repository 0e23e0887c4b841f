"""Who carries messages: the contract, Zenoh, and the bounded inbox."""
