"""What the commands share: how they take arguments, complain, show progress and tables."""

import argparse
import contextlib
import sys

INTERRUPTED = 130  # exit code

_COLUMNS = {  # result: (heading, format)
    "drone": ("drone", "{}"),
    "rms_error_m": ("rms (m)", "{:.4f}"),
    "peak_error_m": ("peak (m)", "{:.4f}"),
    "steady_error_m": ("steady (m)", "{:.4f}"),
    "rms_error_m_s": ("rms (m/s)", "{:.4f}"),
    "peak_error_m_s": ("peak (m/s)", "{:.4f}"),
    "steady_error_m_s": ("steady (m/s)", "{:.4f}"),
    "settled_after_s": ("settled (s)", "{:.2f}"),
    "lowest_z_m": ("z min (m)", "{:.4f}"),
    "highest_z_m": ("z max (m)", "{:.4f}"),
    "peak_vz_m_s": ("vz max (m/s)", "{:.4f}"),
    "peak_speed_m_s": ("|v| max (m/s)", "{:.4f}"),
    "rpm_std": ("RPM std", "{:.1f}"),
    "t_s": ("t (s)", "{:.2f}"),
    "pos_m": ("position (m)", "{:.2e}"),
    "vel_m_s": ("velocity (m/s)", "{:.2e}"),
    "angle_rad": ("attitude (rad)", "{:.2e}"),
    "omega_rad_s": ("rates (rad/s)", "{:.2e}"),
    "rpm": ("rotors (RPM)", "{:.2e}"),
}


class Parser(argparse.ArgumentParser):
    """A parser whose complaints are one line."""

    def error(self, message):  # noqa: D102
        self.exit(2, f"jaxdrones: error: {message}; see {self.prog} --help\n")


def complain(message: str, code: int = 2) -> int:
    """One line on stderr; returns the exit code."""
    print(f"jaxdrones: {'' if code == INTERRUPTED else 'error: '}{message}", file=sys.stderr)
    return code


def bar(total: int | None, what: str, unit: str, initial: int = 0):
    """A progress bar on stderr; nothing without a terminal, `None` without tqdm."""
    try:
        from tqdm import tqdm
    except ImportError:
        return contextlib.nullcontext()
    look = dict(leave=False, disable=None, file=sys.stderr, dynamic_ncols=True)
    return tqdm(total=total, desc=what, unit=unit, initial=initial, **look)


def table(results: list[dict]) -> str:
    """Columns aligned under their headings, one line per drone."""
    names = list(results[0])
    rows = [[_COLUMNS[name][0] for name in names]]
    rows += [["-" if row[name] is None else _COLUMNS[name][1].format(row[name]) for name in names] for row in results]
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return "\n".join("  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in rows)
