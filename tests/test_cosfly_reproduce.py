"""`cosfly reproduce`: every table and figure of the paper is told or left out, places of figures, both beside each other."""

import pytest

from cosfly.pipeline.reproduce import OF_RELEASE, FigureReader, MissingFile, read_paper
from cosfly.runtime.errors import InputError
from cosfly.runtime.journal import Journal
from cosfly.runtime.json_io import write_json
from release.card.tables import SHAPES

# All labels of tables and figures in the paper.
FIGURES = """
    appendix_g_editor appendix_g_excluded_regions appendix_g_projection appendix_h_alg3d_measured
    appendix_h_alg3d_projections appendix_h_four_axis_bar appendix_h_measured_trajectory_grid
    appendix_h_tastar_muco_deltas bertscore_comparison bertscore_distribution box_categories building_circling
    caption_pipeline coc_lengths coc_sample_frame confusion_matrix confusion_patterns consistency_verdict
    cosfly_matrix_world_failure cumulative_trajectories dataset_sample decision_accuracy depth_comparison
    dual_trajectory_pipeline fig17_stage_breakdown fig18_render_scaling fig19_watchdog gpu_utilization
    grid_simplification joint_perturbation pedestrian_trajectory_generation per_map_completion
    pipeline_flowchart pipeline_overview regen_strategy sample_generation simulator_restarts simworld_pipeline
    simworld_step1 simworld_step2 simworld_step5 simworld_step6 sliding_window system_resources teaser
    trajectory_comparison weather_gallery weather_pipeline zoom_demo zoom_fidelity
"""
TABLES = """
    algo_comparison appendix_h_extended_feasibility appendix_h_extended_ranking appendix_h_four_axis_scores
    appendix_h_group_summary appendix_h_scope appendix_h_tastar_muco_delta appendix_h_tastar_muco_win_rates
    augmentation_params augmentation_states baseline_protocol box_categories boxes_schema caption_pipeline
    coc_actions coc_sample_en coc_sample_zh dataset_format_survey depth_format_comparison dist_stats
    distillation_summary drone_params machine_configs ped_params planner_dist quality_stats render_scaling
    simworld_simplify simworld_step4 simworld_step6_cli stage_breakdown tod_presets watchdog_reliability
    weather_cli weather_coverage weather_heatmap weather_meta weather_modes weather_params_fields
    weather_presets zoom_config zoom_conversion zoom_eval
"""
LABELS = [f"fig:{name}" for name in FIGURES.split()] + [f"tab:{name}" for name in TABLES.split()]


def test_every_table_and_figure_of_the_paper_is_told_or_left_out_with_why():
    paper = read_paper()
    told = [*paper.settings, *paper.tables, *(table.more_labels for table in paper.tables.values())]
    told += [SHAPES[key][1] for key in OF_RELEASE]
    left = [label for labels in paper.left_out for label in labels.split(", ")]
    both = {label for labels in told for label in labels.split(", ")}
    assert (sorted(set(LABELS) - both - set(left)), sorted(both & set(left))) == ([], [])
    assert sorted(label for label in {*both, *left} - set(LABELS) if label.startswith(("tab:", "fig:"))) == []
    assert all(paper.left_out.values())


def test_figures_are_found_by_keys_numbers_ids_and_stars(tmp_path):
    write_json(tmp_path / "a.json", {"many": [{"id": "x", "ms": 1}, {"id": "y", "ms": 3}, {"id": "z"}], "none": {}})
    with Journal(tmp_path / "items.jsonl") as journal:
        journal.append({"id": "walk", "rss_mib": {"0": 2.0, "1": 3.0}})
    reader = FigureReader([tmp_path / "absent", tmp_path], {"counts": {"a": 1, "b": 3}})
    for place, expected in {
        "a.json:many.0.ms": [1], "a.json:many.-1.id": ["z"], "a.json:many.y.ms": [3], "a.json:many.9.ms": [None],
        "a.json:many.*.ms|mean,max": [2.0, 3], "a.json:many.x.ms,id + a.json:none": [1, "x", {}],
        "items.jsonl:walk.rss_mib.1": [3.0], "items.jsonl:*.rss_mib|peak": [5.0], "a.json:none.*.ms|mean": [None],
        "work:counts|shares": [{"a": 25.0, "b": 75.0}],
    }.items():  # fmt: skip
        assert reader.figures(place) == expected, place
    with pytest.raises(MissingFile):
        reader.figures("b.json:many")
    with pytest.raises(InputError, match=r"a.json: many.\*.id"):
        reader.figures("a.json:many.*.id|mean")
