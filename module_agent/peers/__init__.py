"""Other modules' rows, gathered by an agent."""
