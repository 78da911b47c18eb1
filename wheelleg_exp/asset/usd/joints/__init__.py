"""Convert the joints of a USD stage to degrees of freedom, tendons, and joint couplings.

| module | what it offers |
|---|---|
| `usd_joints` | the bodies and frames of a joint |
| `joint_axes` | its free axes and their range |
| `joint_drives` | drive, friction, and limits of speed and effort of one axis |
| `articulate` | the degrees of freedom of a body |
| `joint_couplings` | joints that become tendons and couplings |
"""
