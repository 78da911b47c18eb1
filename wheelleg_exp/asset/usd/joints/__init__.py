"""Convert the joints of a USD stage to degrees of freedom, tendons, and joint couplings."""
