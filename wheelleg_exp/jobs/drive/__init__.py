"""Drive a trained robot: by hand in the browser, or from a script.

| module | offers |
|---|---|
| ``run_drive`` | the job: one robot, in real time or as fast as it computes |
| ``drive_session`` | one control step after the other, and the figures of the drive |
| ``drive_controls`` | the axes that can be commanded, and the commands and requests in effect |
| ``drive_script`` | a drive as a YAML file |
| ``drive_page`` | the page in the browser |
"""
