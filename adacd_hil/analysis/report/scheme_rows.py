"""The columns of a run out of the records of /scheme: of a piece of a log, or of rows gathered from many."""

import dataclasses
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from adacd_hil.analysis.logged_run import CertifiedStream, Motion, PaperStream, Run
from adacd_hil.log.reader import Series
from adacd_hil.records import JOINTS
from adacd_hil.settings.configuration import Settings

Rows = NDArray[np.int64]

_TIME: Final = "t_ns"
_PLAIN: Final = ("state", "fault", "contact_joints", "tau_ext_hat", "tau_ext_hat_cad", "theta_hat", "threshold")
_MOTION: Final = ("q", "dq", "tau_J")
_CERTIFIED: Final = ("tau_ext_bank", "threshold_bank", "theta_further", "theta_std", "promotions")
_PAPER: Final = ("paper_is_armed", "paper_tau_ext_hat", "paper_threshold")


class SchemeRows:
    """Rows of /scheme, gathered piece by piece: only the fields that a report reads.

    They lie in one block of memory, which is asked for at once and used as far as it is filled: columns that are
    gathered apart and joined at the end are there twice, and leave holes behind.
    """

    def __init__(self, first: Series, room: int = 1 << 16) -> None:
        """`first`: a piece of /scheme, with or without records, all of which are taken; room: for so many rows."""
        self.count = 0
        self._room = room
        self._begin(first)
        self.add(first)

    def _begin(self, scheme: Series) -> None:
        """Make room for rows of such fields."""
        names = [name for name in ("cycle", *_PLAIN, *_MOTION, *_CERTIFIED, *_PAPER) if name in scheme.fields]
        fields = [(_TIME, np.dtype(np.int64)), *((name, scheme.records.dtype[name]) for name in names)]
        self._rows = np.empty(max(self._room, len(scheme)), np.dtype(fields, align=True))

    def add(self, scheme: Series, rows: Rows | slice = slice(None)) -> None:
        """Take some rows of a piece."""
        if not len(scheme):
            return
        if self.count == 0:
            self._begin(scheme)  # only a record says what fields a log has
        t_ns = scheme.t_ns[rows]
        end = self.count + len(t_ns)
        if end > len(self._rows):
            more = np.empty(max(end, 2 * len(self._rows)), self._rows.dtype)
            more[: self.count] = self._rows[: self.count]
            self._rows = more
        here = self._rows[self.count : end]
        here[_TIME] = t_ns
        for name in (self._rows.dtype.names or ())[1:]:
            here[name] = scheme.records[name][rows]
        self.count = end

    def fill(self, shell: Run) -> Run:
        """Give a run with these rows, else as `shell`."""
        rows = self._rows[: self.count]
        columns = {name: rows[name] for name in rows.dtype.names or ()}
        return dataclasses.replace(shell, **_arrays(columns, shell.settings))


def run_of_piece(scheme: Series, shell: Run) -> Run:
    """Give a run with the rows of one piece, else as `shell`."""
    return SchemeRows(scheme).fill(shell)


def _arrays(columns: dict[str, NDArray[Any]], settings: Settings) -> dict[str, Any]:
    """Give the fields of a run."""
    arrays: dict[str, Any] = {name: columns[name] for name in _PLAIN}
    arrays |= {"cycle": columns["cycle"].astype(np.int64), _TIME: columns[_TIME]}
    arrays["motion"] = Motion(*(columns[name] for name in _MOTION))
    if "tau_ext_bank" in columns:
        shape = (-1, settings.channel_count, JOINTS)
        arrays["certified"] = CertifiedStream(
            tau_ext=columns["tau_ext_bank"].reshape(shape),
            threshold=columns["threshold_bank"].reshape(shape),
            theta_further=columns["theta_further"],
            theta_std=columns["theta_std"],
            promotions=columns["promotions"],
        )
    if "paper_is_armed" in columns:
        arrays["beside"] = PaperStream(
            is_armed=columns["paper_is_armed"] > 0.5,
            tau_ext_hat=columns["paper_tau_ext_hat"],
            threshold=columns["paper_threshold"],
        )
    return arrays
