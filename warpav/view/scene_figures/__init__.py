"""The thesis's figures of traffic scenes, 4 to 9 and 14 to 16. Every function draws one and returns its path.

Importing a module of this package imports neither matplotlib nor pyvista.
"""
