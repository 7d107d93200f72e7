"""Writing a restored image to a FITS file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

from torchmask.data.light import clouded_frames
from torchmask.grid import ARCSEC
from torchmask.io import as_array, atomic_write, extra
from torchmask.observation import Observation
from torchmask.optics.sky_scale import cards_at
from torchmask.restoration.result import RestorationResult


def save_restored(
    path: str | Path, result: RestorationResult, observation: Observation, history: str | Sequence[str] = ()
) -> None:
    """Write the restored object to a new FITS file, with the observation's sky coordinates.

    Parameters
    ----------
    path : str or Path
        Name of the file, which must end in .fits. The file is written completely or not at all, and never replaces
        another.
    result : RestorationResult
        Restored object with its statistics.
    observation : Observation
        Observation from which the object was restored. The cards of its header (sky coordinates, target, telescope,
        filter) are copied, at the pixel scale of its grid. A shift common to all frames cannot be distinguished from
        one of the object, so the coordinates are only as accurate as the mean tilt of the frames.
    history : str or sequence of str
        What was done, as HISTORY cards.

    Raises
    ------
    ValueError
        If the object and the frames differ in shape, the file exists, its folder does not exist, or its name does not
        end in .fits.

    Notes
    -----
    The image is in electrons per pixel and frame (BUNIT). CHISQ is the mean square residual in units of the noise,
    averaged over frames, and CHISQMAX that of the worst frame. CONVERGD says whether the restoration converged, and
    EXPLAIND whether object and aberrations explain the frames, that is whether CHISQRED is at most CHISQLIM. NCLOUD
    counts the frames that seem to have been taken through a cloud, and CLOUDED names them, counted from 0. If the
    restoration computed standard deviations, they are in an extension ERR. There is no SKY where no sky was assumed,
    or none found.

    Examples
    --------
    >>> import tempfile, torch
    >>> from torchmask.grid import Grid
    >>> from torchmask.optics.aperture import SparseAperture
    >>> from torchmask.restoration.myopic import MyopicDeconvolution
    >>> frames = torch.full((4, 32, 32), 2.0); frames[:, 12:20, 12:20] = 100.0
    >>> frames = torch.poisson(frames, generator=torch.Generator().manual_seed(0))
    >>> mask = SparseAperture([[0.0, 0.3], [-0.3, -0.2], [0.3, -0.2]], 0.2, 1.0)
    >>> observation = Observation(frames, mask, Grid.nyquist(1.0, 550e-9, 32), readout_noise=None)
    >>> result = MyopicDeconvolution(mask, observation.grid, n_modes=3, max_iterations=3).restore(frames)
    >>> save_restored(tempfile.mkdtemp() + "/restored.fits", result, observation, history="an example")
    """
    with extra("data"):
        from astropy.io import fits

    if Path(path).suffix != ".fits":
        raise ValueError(f"{path} does not end in .fits: give a name that does")
    if tuple(result.object.shape) != observation.grid.shape:
        raise ValueError(
            f"the object has shape {tuple(result.object.shape)} and the frames {observation.grid.shape}: give the "
            "observation from which it was restored"
        )
    hdu = fits.PrimaryHDU(as_array(result.object).astype("float64"))
    hdus = fits.HDUList([hdu])
    for name, value in cards_at(observation.header, observation.grid.pixel_scale).items():
        if name not in hdu.header:
            hdu.header[name] = value
    cards = {
        "BUNIT": ("electron", "per pixel and frame"),
        "WAVELEN": (observation.grid.wavelength, "[m] wavelength"),
        "PIXELSCL": (observation.grid.pixel_scale / ARCSEC, "[arcsec] side of a pixel"),
        "NFRAMES": (len(observation.frames), "frames restored from"),
        "NHOLES": (observation.aperture.n_subapertures, "sub-apertures of the mask"),
        "NMODES": (result.coefficients.shape[-1], "Zernike modes per sub-aperture and frame"),
        "CHISQ": (float(result.chi_square.mean()), "mean square residual over noise"),
        "CHISQMAX": (float(result.chi_square.max()), "the same of the worst frame"),
        "NOISE": (result.noise, "[electron] rms per pixel and frame"),
        "SKY": (result.sky, "[electron] mean light of the sky in a pixel"),
        "PRIOR": (_in_a_card(result.prior), ""),  # which fills its card
        "R0": (result.r0, "[m] Fried parameter of the prior"),
        "CONVERGD": (result.converged, "whether the restoration came to rest"),
    }
    if (verdict := result.verdict) is not None:
        cards |= {
            "VERDICT": (verdict.finding.value, "of the fit"),  # the longest fills its card
            "EXPLAIND": (verdict.explained, "whether the frames are explained"),
            "CHISQDOF": (verdict.degrees_of_freedom, "degrees of freedom"),
            "CHISQRED": (verdict.chi_square, "chi-square over degrees of freedom"),
            "CHISQMOD": (verdict.model_error, "that modes left out are expected to add"),
            "CHISQLIM": (verdict.limit, "up to which the frames are explained"),
            "NLOST": (len(verdict.frames), "frames that are not explained"),
        }
    if result.sky == 0:
        del cards["SKY"]  # none was assumed, and 0 would read as a measurement
    clouded = clouded_frames(observation)
    cards["NCLOUD"] = (len(clouded), "frames (CLOUDED) below half the usual light")
    if clouded:
        cards["CLOUDED"] = (",".join(map(str, clouded)), "")  # many go on in CONTINUE cards, which hold no comment
    for name, (value, comment) in cards.items():
        if not isinstance(value, float) or math.isfinite(value):  # FITS cards cannot hold NaN
            hdu.header[name] = (value, comment)
    lines = [history] if isinstance(history, str) else list(history)
    for line in ["restored by torchmask.MyopicDeconvolution", *lines]:
        hdu.header.add_history(_in_a_card(line))
    if result.object_std is not None:
        errors = fits.ImageHDU(as_array(result.object_std).astype("float64"), name="ERR")
        for name in (*observation.header, "BUNIT", "PIXELSCL"):
            if name in hdu.header and name not in errors.header:
                errors.header[name] = (hdu.header[name], hdu.header.comments[name])
        hdus.append(errors)
    content = BytesIO()  # astropy rejects the mode in which atomic_write opens files
    hdus.writeto(content, checksum=True)
    with atomic_write(path) as file:
        file.write(content.getvalue())


def _in_a_card(text: str) -> str:
    """Return the text in one line of ASCII, as FITS wants it."""
    return " ".join(line.strip() for line in text.encode("ascii", "replace").decode().splitlines())
