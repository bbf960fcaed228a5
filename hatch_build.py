"""Builds the page of the viewer with npm, where it is missing, when the package is built from a checkout."""

import shutil
import subprocess
from pathlib import Path

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class ViewerPage(BuildHookInterface):
    """Bundle viewer/ into one page. An sdist needs the page; an installation without it lacks the viewer alone."""

    def initialize(self, version, build_data):
        """Build the page."""
        if (Path(self.root) / "jaxdrones/visualization/viewer/page.html").exists():
            return
        try:
            self.bundle()
        except (OSError, subprocess.SubprocessError) as error:
            message = f"the page of the viewer is missing and could not be built ({error}); see `make viewer`"
            if self.target_name == "sdist":
                raise RuntimeError(message) from error
            self.app.display_warning(message)

    def bundle(self):
        """Run npm in viewer/."""
        npm = shutil.which("npm")
        if npm is None:
            raise FileNotFoundError("npm was not found")
        for command in (["ci", "--no-audit", "--no-fund"], ["run", "build"]):
            subprocess.run([npm, *command], cwd=Path(self.root) / "viewer", check=True, timeout=300)
