"""Left and right: what a robot's mirror image observes and does, for rsl_rl's symmetry extension.

| module | what it offers |
|---|---|
| `joints` | which joint is which one's image, and with which sign, from the compiled model |
| `bodies` | which body is which one's image, and whose axes are |
| `rules` | how each kind of observation turns in a mirror |
| `turning`, `sensed` | what each rule makes of a term, of rays and IMUs |
| `mirror` | the images of whole observations and actions |
| `mirror_loss` | the mirror loss, at less cost |
"""

from wheelleg_exp.rl.symmetry.mirror import Mirror, left_right

__all__ = ["Mirror", "left_right"]
