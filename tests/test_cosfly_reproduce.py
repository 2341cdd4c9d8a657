"""`cosfly reproduce`: every table and figure of the paper is told or left out, places of figures, both beside each other."""

import pytest

from cosfly.pipeline.reproduce import OF_RELEASE, MissingFile, Paper, Places, read_paper
from cosfly.runtime.errors import InputError
from cosfly.runtime.journal import Journal
from cosfly.runtime.json_io import write_json
from release.stats.tables import SHAPES

# All labels of tables and figures in the paper.
LABELS = [
    "fig:appendix_g_editor",
    "fig:appendix_g_excluded_regions",
    "fig:appendix_g_projection",
    "fig:appendix_h_alg3d_measured",
    "fig:appendix_h_alg3d_projections",
    "fig:appendix_h_four_axis_bar",
    "fig:appendix_h_measured_trajectory_grid",
    "fig:appendix_h_tastar_muco_deltas",
    "fig:bertscore_comparison",
    "fig:bertscore_distribution",
    "fig:box_categories",
    "fig:building_circling",
    "fig:caption_pipeline",
    "fig:coc_lengths",
    "fig:coc_sample_frame",
    "fig:confusion_matrix",
    "fig:confusion_patterns",
    "fig:consistency_verdict",
    "fig:cosfly_matrix_world_failure",
    "fig:cumulative_trajectories",
    "fig:dataset_sample",
    "fig:decision_accuracy",
    "fig:depth_comparison",
    "fig:dual_trajectory_pipeline",
    "fig:fig17_stage_breakdown",
    "fig:fig18_render_scaling",
    "fig:fig19_watchdog",
    "fig:gpu_utilization",
    "fig:grid_simplification",
    "fig:joint_perturbation",
    "fig:pedestrian_trajectory_generation",
    "fig:per_map_completion",
    "fig:pipeline_flowchart",
    "fig:pipeline_overview",
    "fig:regen_strategy",
    "fig:sample_generation",
    "fig:simulator_restarts",
    "fig:simworld_pipeline",
    "fig:simworld_step1",
    "fig:simworld_step2",
    "fig:simworld_step5",
    "fig:simworld_step6",
    "fig:sliding_window",
    "fig:system_resources",
    "fig:teaser",
    "fig:trajectory_comparison",
    "fig:weather_gallery",
    "fig:weather_pipeline",
    "fig:zoom_demo",
    "fig:zoom_fidelity",
    "tab:algo_comparison",
    "tab:appendix_h_extended_feasibility",
    "tab:appendix_h_extended_ranking",
    "tab:appendix_h_four_axis_scores",
    "tab:appendix_h_group_summary",
    "tab:appendix_h_scope",
    "tab:appendix_h_tastar_muco_delta",
    "tab:appendix_h_tastar_muco_win_rates",
    "tab:augmentation_params",
    "tab:augmentation_states",
    "tab:baseline_protocol",
    "tab:box_categories",
    "tab:boxes_schema",
    "tab:caption_pipeline",
    "tab:coc_actions",
    "tab:coc_sample_en",
    "tab:coc_sample_zh",
    "tab:dataset_format_survey",
    "tab:depth_format_comparison",
    "tab:dist_stats",
    "tab:distillation_summary",
    "tab:drone_params",
    "tab:machine_configs",
    "tab:ped_params",
    "tab:planner_dist",
    "tab:quality_stats",
    "tab:render_scaling",
    "tab:simworld_simplify",
    "tab:simworld_step4",
    "tab:simworld_step6_cli",
    "tab:stage_breakdown",
    "tab:tod_presets",
    "tab:watchdog_reliability",
    "tab:weather_cli",
    "tab:weather_coverage",
    "tab:weather_heatmap",
    "tab:weather_meta",
    "tab:weather_modes",
    "tab:weather_params_fields",
    "tab:weather_presets",
    "tab:zoom_config",
    "tab:zoom_conversion",
    "tab:zoom_eval",
]


@pytest.fixture(scope="module")
def paper() -> Paper:
    return read_paper()


def test_every_table_and_figure_of_the_paper_is_told_or_left_out_with_why(paper):
    told = [*paper.settings, *paper.tables, *(table.also for table in paper.tables.values())]
    told += [SHAPES[key][1] for key in OF_RELEASE]
    left = [label for labels in paper.left_out for label in labels.split(", ")]
    both = {label for labels in told for label in labels.split(", ")}
    assert sorted(set(LABELS) - both - set(left)) == []
    assert sorted(both & set(left)) == []
    assert sorted(label for label in {*both, *left} - set(LABELS) if label.startswith(("tab:", "fig:"))) == OURS
    assert all(paper.left_out.values())


OURS = ["tab:beam", "tab:trunks"]  # the paper tells these in words


def test_figures_are_found_by_keys_numbers_ids_and_stars(tmp_path):
    write_json(tmp_path / "a.json", {"many": [{"id": "x", "ms": 1}, {"id": "y", "ms": 3}, {"id": "z"}], "none": {}})
    with Journal(tmp_path / "items.jsonl") as journal:
        journal.append({"id": "walk", "rss_mib": {"0": 2.0, "1": 3.0}})
    places = Places([tmp_path / "absent", tmp_path], {"counts": {"a": 1, "b": 3}})
    for place, expected in {
        "a.json:many.0.ms": [1], "a.json:many.-1.id": ["z"], "a.json:many.y.ms": [3], "a.json:many.9.ms": [None],
        "a.json:many.*.ms|mean,max": [2.0, 3], "a.json:many.x.ms,id + a.json:none": [1, "x", {}],
        "items.jsonl:walk.rss_mib.1": [3.0], "items.jsonl:*.rss_mib|peak": [5.0], "a.json:none.*.ms|mean": [None],
        "work:counts|shares": [{"a": 25.0, "b": 75.0}],
    }.items():  # fmt: skip
        assert places.figures(place) == expected, place
    with pytest.raises(MissingFile):
        places.figures("b.json:many")
    with pytest.raises(InputError, match=r"a.json: many.\*.id"):
        places.figures("a.json:many.*.id|mean")
