"""Report of a benchmark as one HTML page; needs matplotlib and jinja2, which the extra "plot" installs."""
