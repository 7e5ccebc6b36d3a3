"""Load tests and measurements of servers that run as users run them."""
