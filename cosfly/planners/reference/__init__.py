"""The paper's reference planners (app:three_axis_eval): generic ones, which know where to go and nothing of sight."""
