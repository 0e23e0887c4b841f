"""The world in which modules move, its bus, and its truth."""
