"""The state machine of an association, which ends it on a sequence that the standard does not define."""

from __future__ import annotations

import logging

from pynetdicom.fsm import InvalidEventError, StateMachine

from stereoreg_ros.reception.bounded_socket import BoundedSocket, describe

_LOG = logging.getLogger(__name__)


class EndingStateMachine(StateMachine):
    """pynetdicom's own would end its thread with an error where a client's PDUs come in a meaningless order."""

    def do_action(self, event: str) -> None:
        """Take the step for `event`, or end the association."""
        try:
            super().do_action(event)
        except InvalidEventError as error:
            _LOG.warning("association of %s ended: %s", describe(self.dul.assoc), error)
            if isinstance(self.dul.socket, BoundedSocket):
                self.dul.socket.release()
            self.dul.kill_dul()
