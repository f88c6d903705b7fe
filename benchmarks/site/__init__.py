"""The documentation's generated parts: the command line's and the configuration's page, the tables
of results, and what mkdocs needs to build the site.
"""
