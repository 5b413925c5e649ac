"""What is believed of the friction between two things of which nothing is said: one prior, and what follows from it.

Wood, cardboard and plastics slide on each other at Coulomb coefficients of .2 to .8.
"""

MEDIAN, SPREAD = 0.35, 0.8
"""Of a log-normal distribution, the spread of the logarithm: 90 % lie between .09 and 1.3."""
RESTING = 0.6
"""Of what an image shows at rest, its upper quartile: rough things stay where they are put, smooth ones do not."""
OF_BODIES = 0.8
"""Of bodies in a scene file that say none, which six in seven are below: a scene is to stand by its geometry."""
