"""Received signal strength: one level for each link."""

from gaigs.core.task.scalar import Scalar
from gaigs.registry import register


@register("task", "rssi")
class Rssi(Scalar):
    """RSSI [dBm] as read, neither scaled nor shifted; errors are in dB.

    Source: the protocol of GAI-GS, "Evaluation".
    """

    name, quantity, unit, error_unit = "rssi", "RSSI", "dBm", "dB"
    limits = -200.0, 30.0
    beyond = "\nconvert path losses, percent, volts and powers to dBm"
