"""Builds the page of the viewer, where it is not there yet, when the package is built or installed from its sources."""

import shutil
import subprocess
from pathlib import Path

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class ViewerPage(BuildHookInterface):
    """Bundles viewer/ into one page by npm; without npm everything but the viewer is installed."""

    def initialize(self, version, build_data):
        """Build the page."""
        viewer = Path(self.root) / "viewer"
        if (Path(self.root) / "jaxdrones/visualization/viewer/page.html").exists():
            return
        npm = shutil.which("npm")
        if npm is None:
            self.app.display_warning("npm was not found, so the viewer is not built; see `make viewer`")
            return
        try:
            for command in (["ci", "--no-audit", "--no-fund"], ["run", "build"]):
                subprocess.run([npm, *command], cwd=viewer, check=True, timeout=300)
        except (OSError, subprocess.SubprocessError) as error:
            self.app.display_warning(f"the viewer is not built ({error}); see `make viewer`")
