"""A benchmark's results as one page. Needs matplotlib and jinja2, which the extra "plot" brings."""
