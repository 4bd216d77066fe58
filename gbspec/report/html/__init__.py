"""The report of a run as one HTML file that needs nothing else: MathML for equations, plots that zoom, tables."""
