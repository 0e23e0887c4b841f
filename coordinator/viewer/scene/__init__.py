"""What the view shows: geometry, graphs, time series, blueprint."""
