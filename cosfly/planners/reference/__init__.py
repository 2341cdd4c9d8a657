"""The paper's reference planners (app:three_axis_eval): generic ones, without a visibility term."""
