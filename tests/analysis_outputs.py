"""Names of all tables and figures that an analysis writes (helpers, no tests)."""

FIGURES = {
    *("figure_4", "figure_5", "figure_6", "kaplan_meier", "sensitivity", "steps_per_seed", "differences"),
    *(
        "learning_curves",
        "episode_length",
        "forward_velocity",
        "transfer_metrics",
        "training_speed",
        "wall_clock",
        "return_profiles",
    ),
}
TABLES = {
    *("table1", "table2", "table3", "published_table3", "cells", "transfer", "steps_to_threshold", "comparisons"),
    *("sensitivity", "sensitivity_points", "sensitivity_overview", "paired", "blocks"),
    *("equivalence", "aggregates", "improvement", "cost"),
}
