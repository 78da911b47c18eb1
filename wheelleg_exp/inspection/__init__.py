"""Inspect recordings: summaries, statistics, tables, plots, pictures, and Rerun's viewer.

| module | offers |
|---|---|
| ``recording_target``, ``row_selection`` | the file of a recording, and the selected rows and time spans |
| ``recorded_numbers`` | recorded numbers by name, their frames and statistics |
| ``condition_query`` | the times at which a condition on numbers is true |
| ``episode_measures`` | recorded episodes; tracking errors, forces, efforts, and rewards |
| ``recording_summary``, ``compare_recordings``, ``export_numbers`` | a summary, a comparison, Parquet and CSV |
| ``recording_plots``, ``motion_plots``, ``training_curves``, ``evaluation_plots`` | plots by name, and their panels |
| ``plot_data``, ``plot_style`` | the numbers of plots, and fonts, colours, and layout |
| ``recorded_scene``, ``recording_pictures``, ``recording_video`` | pictures and videos of the recorded robot |
| ``robot_picture`` | a picture of a robot's initial state, without a recording |
| ``rerun_viewer`` | Rerun's viewer in a window, in a browser, or as a screenshot |
"""
