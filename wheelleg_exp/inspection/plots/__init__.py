"""The figures that a recording is looked at with.

| module | offers |
|---|---|
| ``plots`` | figures by name, a page by purpose, overlays |
| ``motion``, ``training_curves`` | panels of motion and of training |
| ``plot_data`` | the numbers that are drawn |
| ``style`` | fonts, colours, files that repeat |
"""
