import tcmrl_data
from tests.conftest import TINY


def test_a_plan_counts_what_a_build_makes() -> None:
    recipe = tcmrl_data.load_recipe("point-robot", profile="quick", overrides=TINY)
    plan = tcmrl_data.plan_build(recipe, tasks=[0, 3, 4], workers=2)
    assert (plan.tasks, plan.train, plan.test, plan.snapshots, plan.parts) == (3, 2, 1, 3, 9)
    assert (plan.episodes, plan.training_steps, plan.rollout_steps) == (54, 450, 1080)
    assert plan.bytes == 54 * 21 * (4 * 5 + 2)
    assert plan.seconds > 0
