"""What all commands have in common: version, help, interruption."""

import signal
import subprocess
import sys
import time
from importlib.metadata import version

import typer

from command_line import planish
from planish.cli import make_app

#: The command has begun its work when it has made its first file; on a busy machine that takes a while.
BEGUN_SECONDS = 60.0


def test_the_version_is_printed():
    outcome = planish("--version")
    assert outcome.code == 0
    assert outcome.out.strip() == f"planish {version('planish')}"


def test_without_a_command_the_help_lists_all_of_them():
    outcome = planish("--help")
    assert outcome.code == 0
    for command in ("simulate", "measure", "import", "register", "evaluate", "demo"):
        assert command in outcome.out


def test_an_unknown_command_ends_with_2():
    outcome = planish("unheard-of")
    assert outcome.code == 2
    assert "unheard-of" in outcome.err


def test_an_interrupt_ends_with_130_and_words(tmp_path):
    command = [sys.executable, "-c", "from planish.cli import main; main()", "demo", "--out", str(tmp_path)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    given_up = time.monotonic() + BEGUN_SECONDS
    while not any(tmp_path.iterdir()) and time.monotonic() < given_up:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=120)
    assert process.returncode == 130
    assert "interrupted" in err
    assert "Traceback" not in err


def test_no_help_text_has_brackets_which_the_console_would_swallow():
    app = typer.main.get_command(make_app())
    texts = [(name, p.name, getattr(p, "help", None)) for name, c in app.commands.items() for p in c.params]
    assert len(texts) > 50
    assert [text for text in texts if "[" in (text[2] or "")] == []
