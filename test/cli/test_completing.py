"""The completion script completes commands and options in bash."""

import shutil
import subprocess

import pytest

from omsm_ros import cli
from omsm_ros.cli.words import WORDS

pytest.importorskip("shtab", reason="shtab is an optional package")


@pytest.fixture(scope="module")
def script(tmp_path_factory):
    path = tmp_path_factory.mktemp("completion") / "omsm.bash"
    with pytest.MonkeyPatch.context() as patch:
        written = []
        patch.setattr("builtins.print", lambda text, **_: written.append(text))
        assert cli.main(["completion", "bash"]) == 0
    path.write_text("\n".join(written))
    return path


@pytest.mark.skipif(shutil.which("bash") is None, reason="there is no bash")
@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("omsm cor", {"correct"}),
        ("omsm correct --cal", {"--calibration"}),
        ("omsm correct sca", {"scan.mcap"}),
        ("omsm identify --hold z", {"zero-order"}),
        ("omsm ", set(WORDS)),
    ],
)
def test_what_bash_offers(script, tmp_path, line, expected):
    (tmp_path / "scan.mcap").touch()
    words = line.split(" ")
    program = (
        f"source {script}\n"
        f"COMP_WORDS=({' '.join(words[:-1])} '{words[-1]}'); COMP_CWORD={len(words) - 1}\n"
        f"COMP_LINE='{line}'; COMP_POINT={len(line)}\n"
        '_shtab_omsm; printf "%s\\n" "${COMPREPLY[@]}"\n'
    )
    done = subprocess.run(
        ["bash", "-c", program], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert set(done.stdout.split()) >= expected, done.stderr
    assert len(expected) > 5 or set(done.stdout.split()) == expected


def test_where_shtab_is_not_installed_the_remedy_is_reported(capsys, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "shtab", None)
    assert cli.main(["completion", "zsh"]) == 2
    assert "pip install shtab" in capsys.readouterr().err
