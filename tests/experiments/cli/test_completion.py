"""The completion of a shell is installed by the program."""

from __future__ import annotations

from tests.in_process import trackwright


def test_it_is_installed_into_the_home_of_the_user(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    said = trackwright("--install-completion", "--shell", "bash")
    assert said.code == 0, said
    (installed,) = (path for path in tmp_path.rglob("trackwright") if path.is_file())
    assert "--held-out" in installed.read_text()
    assert str(installed) in (tmp_path / ".bashrc").read_text()
