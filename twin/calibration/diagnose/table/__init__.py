"""One table of groups, one posterior, one verdict: what a fit's residuals show.

A *group* is a cause's columns beside those of the geometry, with one width: the phantom is
strained, beads are elsewhere, the panel distorts, something moves, beads slip (`groups`, one file
a cause). y = J d + sum of B_g w_g + e, with d and w_g normal and the noise e unknown: the
columns' products at the fit are the table (`linearised`); which groups are there, how wide, and
what the geometry is over all that the images leave open is one posterior (`posterior`); what is
said and offered follows from it by a table of policies (`verdict`). Nothing else widens a sigma
for what residuals show.
"""
