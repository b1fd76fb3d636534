"""The table `[collision]` of an experiment file."""

import numpy as np
import pytest

from jaxid.experiment.experiment import load_experiment
from jaxid.robot import library

ARM = """
[robot]
convention = "modified"
dh = [
  { alpha = 0, a = 0, d = 0.3, name = "turn" },
  { alpha = -90, a = 0, d = 0, name = "lift" },
  { alpha = 0, a = 0.5, d = 0, name = "bend" },
]
"""
SHAPES = """
[collision]
distance = 0.05
ground = -0.1

[[collision.capsules]]
name = "column"
body = "ground"
start = [0, 0, 0]
end = [0, 0, 0.3]
radius = 0.1

[[collision.capsules]]
name = "hand"
body = "bend"
start = [0.4, 0, 0]
radius = 0.08

[[collision.boxes]]
name = "table"
centre = [0.5, 0, 0]
size = [0.4, 1, 0.1]
rotation = [0, 0, 90]
"""


def loaded(tmp_path, text):
    path = tmp_path / "experiment.toml"
    path.write_text(text)
    return load_experiment(path)


def test_shapes_come_from_the_file(tmp_path):
    experiment = loaded(tmp_path, ARM + SHAPES)
    model = experiment.collision
    assert model.pair_names == ("column and hand", "hand and table", "hand and ground")
    assert experiment.clearance == 0.05
    gaps = np.asarray(model.clearance(experiment.robot, np.zeros(3)))
    # At zero the hand is at 0.9 m along x, at the height of the shoulder.
    assert gaps[2] == pytest.approx(0.3 + 0.1 - 0.08, abs=1e-5)
    assert gaps[0] == pytest.approx(0.9 - 0.18, abs=1e-5)


def test_pairs_can_be_named(tmp_path):
    named = SHAPES.replace("ground = -0.1", 'pairs = [["hand", "table"]]')
    assert loaded(tmp_path, ARM + named).collision.pair_names == ("hand and table",)


def test_without_the_table_there_is_nothing(tmp_path):
    assert loaded(tmp_path, ARM).collision is None


def test_the_built_in_shapes_are_those_of_the_library(tmp_path):
    text = '[robot]\nbuiltin = "tx90l_on_rail"\n[collision]\nfit = true\n'
    model = loaded(tmp_path, text).collision
    assert model.pair_names == library.tx90l_on_rail_collision().pair_names


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('body = "bend"', 'body = "wrist"', r"`collision`: `body` of capsule `hand`.*turn, lift"),
        ("radius = 0.08", "radius = -1", r"collision\.capsules\[1\]\.radius"),
        ("ground = -0.1", 'pairs = [["hand", "chair"]]', "`chair` is none of the shapes"),
        ("ground = -0.1", "fit = true", "`fit` needs `robot.urdf`"),
        ("ground = -0.1", "grund = 1.0", "did you mean `ground`"),
    ],
)
def test_errors_name_the_table(tmp_path, old, new, message):
    with pytest.raises(ValueError, match=message):
        loaded(tmp_path, ARM + SHAPES.replace(old, new))
