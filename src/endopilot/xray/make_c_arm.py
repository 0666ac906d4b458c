"""The C-arm that a navigation asks for."""

from __future__ import annotations

from endopilot.errors import InputError
from endopilot.tasks.navigation import Navigation
from endopilot.xray.fluoroscope import CArm, Fluoroscope, FluoroscopeConfig


def make_c_arm(
    navigation: Navigation,
    *,
    config: FluoroscopeConfig | None = None,
    seed: int = 0,
    registration_mm: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> CArm:
    """Return the C-arm of a navigation, whose exposures are what `Navigation.xray` says.

    Args:
        navigation: vessel, wire and what is known of its motion.
        config: geometry and errors.
        seed: of the pose that a patient lies in whose images are taken, and of these images' noise.
        registration_mm: the wire shows displaced by this, mm LPS.

    Raises:
        InputError: images of a wire in a catheter, or of a vessel that is not recognised in them.
    """
    anatomy, device, known = navigation.anatomy, navigation.device, navigation.known_motion
    if navigation.xray == "assumed":
        return Fluoroscope(
            anatomy, device.tip_radius_mm, config=config, known_motion=known, registration_mm=registration_mm
        )
    from endopilot.xray.image_fluoroscope import ImageFluoroscope  # slow to import

    if navigation.catheters:
        names = ", ".join(catheter.name for catheter in navigation.catheters)
        raise InputError(
            f"xray: images: the detector takes a wire alone, and there is {names} around it; leave the catheter out"
        )
    return ImageFluoroscope(
        anatomy, device, config=config, seed=seed, known_motion=known, registration_mm=registration_mm
    )
