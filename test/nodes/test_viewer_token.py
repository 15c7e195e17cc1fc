"""The viewer's token stands in a file of its owner, and in nothing that others can read."""

import pytest

pytest.importorskip("omsm_msgs", reason="the messages are not built")

from omsm_ros.errors import ConfigurationError, FileError
from omsm_ros.nodes.viewer_node import PARAMETERS, load_token


def token_file(folder, content, mode=0o600):
    path = folder / "token"
    path.write_text(content)
    path.chmod(mode)
    return str(path)


def test_a_token_is_the_one_word_of_its_file(tmp_path):
    assert load_token(token_file(tmp_path, "0123456789abcdef\n")) == "0123456789abcdef"


@pytest.mark.parametrize("mode", [0o644, 0o640, 0o604, 0o620])
def test_a_file_that_others_may_read_is_refused(tmp_path, mode):
    with pytest.raises(ConfigurationError, match="chmod 600") as refused:
        load_token(token_file(tmp_path, "0123456789abcdef", mode))
    assert "0123456789abcdef" not in str(refused.value)


@pytest.mark.parametrize("content", ["", "  \n", "two words", "a\nb"])
def test_a_file_without_a_token_is_refused_without_showing_it(tmp_path, content):
    with pytest.raises(ConfigurationError, match="holds no token") as refused:
        load_token(token_file(tmp_path, content))
    assert "words" not in str(refused.value)


def test_no_file_and_a_large_one_are_refused(tmp_path):
    with pytest.raises(FileError, match="no token file"):
        load_token(str(tmp_path / "absent"))
    with pytest.raises(FileError, match="more than"):
        load_token(token_file(tmp_path, "x" * 10_000))


def test_no_parameter_holds_the_token_itself():
    assert "token" not in {parameter.name for parameter in PARAMETERS}
    assert "token_file" in {parameter.name for parameter in PARAMETERS}
