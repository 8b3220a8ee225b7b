"""Prints docs/settings.md: every setting with default, bounds, unit and meaning, as the product declares it.

    python tools/settings_page.py >docs/settings.md

Exit status: 0 printed, 2 wrong usage.
"""

import argparse
import sys

from adacd_hil.settings.setting_keys import keys_of, sections

HEAD = (
    "# Settings\n\n"
    "For whoever writes a configuration: every key with its default, its bounds in brackets, and its meaning. "
    "`adacd-hil config docs` explains them on the terminal. `python tools/settings_page.py` prints this page. How a "
    "configuration is found, extended and overridden: [overview.md](overview.md#configuration).\n\n"
    "The built-in configurations in `adacd_hil/configs` and their profiles override many defaults, above all those of "
    "`arm`, `controller` and the thresholds.\n"
)


def page() -> str:
    """Return the page."""
    lines = [HEAD]
    for name, section, meaning in sections():
        lines.append(f"## {name}: {meaning}\n" if name else "## Top of the file\n")
        prefix = f"{name}." if name else ""
        for known in keys_of(section, prefix):
            bounds = f" ({known.bounds})" if known.bounds else ""
            lines.append(f"- `{known.key}` {known.default}{bounds}: {known.meaning}")
        lines.append("")
    return "\n".join(lines)


def main() -> int:
    """Run the command line."""
    argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0]).parse_args()
    sys.stdout.write(page())
    return 0


if __name__ == "__main__":
    sys.exit(main())
