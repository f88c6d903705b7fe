"""The documentation's generated parts: the alerts' page, the tables of results, and what mkdocs
needs to build the site.
"""
