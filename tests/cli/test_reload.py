"""``cab-forecast reload``."""

import json
from pathlib import Path

from structlog.testing import capture_logs
from typer.testing import CliRunner

from cli.main import app
from tests.model.checkpoints import copy_bundled
from tests.service.servers import in_thread, settings

SMALL = "trajectron-no-context"


def test_it_tells_what_took_over_and_fails_if_one_was_refused(tmp_path: Path) -> None:
    copy_bundled(tmp_path / "one", SMALL, "2.0.0")
    with (
        capture_logs(),
        in_thread(settings(models=tmp_path, default_model=SMALL, max_batch_agents=2)) as server,
    ):
        to = ["--endpoint", server.grpc_address]
        copy_bundled(tmp_path / "two", SMALL, "2.1.0")
        result = CliRunner().invoke(app, ["reload", *to])
        assert result.exit_code == 0
        lines = result.stdout.splitlines()
        assert lines == [f"loaded: {SMALL}@2.1.0", "dropped: none", f"default: {SMALL}@2.1.0"]
        (tmp_path / "two" / "config.json").write_text("{}")
        result = CliRunner().invoke(app, ["reload", *to])
        assert result.exit_code == 1
        assert "refused: two: " in result.stdout
        result = CliRunner().invoke(app, ["reload", "--json", *to])
        assert result.exit_code == 1
        assert json.loads(result.stdout)["refused"][0]["folder"] == "two"
