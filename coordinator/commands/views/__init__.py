"""What commands show: live screens, and tables of results."""
