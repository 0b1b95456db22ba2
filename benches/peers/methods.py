# SPDX-License-Identifier: MIT OR Apache-2.0
"""Other programs' and other methods' ways to a phase, as a user of them would call them, and how phases are scored.

Each demodulation takes an 8-bit image whose fringes cross its rows and the nominal period in pixels, and returns the wrapped
phase of every pixel. Each unwrapping takes a wrapped phase and a mask."""

import time

import cv2
import numpy as np
import scipy.fft
import scipy.ndimage
from skimage.restoration import unwrap_phase

TAU = 2.0 * np.pi
cv2.setNumThreads(1)


def timed(work, repetitions=5):
    """Its result, and median and least time, ms, after one run that is not counted."""
    result = work()
    times = []
    for _ in range(repetitions):
        began = time.perf_counter()
        result = work()
        times.append(1e3 * (time.perf_counter() - began))
    return result, {"median_ms": float(np.median(times)), "least_ms": min(times)}


def wrap(x):
    return x - TAU * np.round(x / TAU)


# Demodulation.


def fourier_rows(image, period):
    """Fourier transform profilometry (Takeda): each row, one-sided band with soft edges around the carrier."""
    spectrum = scipy.fft.rfft(image.astype(np.float32), axis=1, workers=1)
    frequency = np.arange(spectrum.shape[1]) / image.shape[1]
    low, high = 1.0 / (1.5 * period), 1.0 / (0.64 * period)
    soft = 0.15 / period
    band = np.clip((frequency - low) / soft + 0.5, 0, 1) * np.clip((high - frequency) / soft + 0.5, 0, 1)
    full = np.zeros(image.shape, np.complex64)
    full[:, : spectrum.shape[1]] = spectrum * band.astype(np.float32)
    return np.angle(scipy.fft.ifft(full, axis=1, workers=1, overwrite_x=True))


def fourier_plane(image, period):
    """The same in two dimensions with a Gaussian window, which also averages along the fringes."""
    spectrum = scipy.fft.fft2(image.astype(np.float32), workers=1)
    fx = scipy.fft.fftfreq(image.shape[1])[None, :]
    fy = scipy.fft.fftfreq(image.shape[0])[:, None]
    sigma = 0.28 / period
    window = np.exp(-((fx - 1.0 / period) ** 2 + fy**2) / (2.0 * sigma**2))
    spectrum *= window.astype(np.float32)
    return np.angle(scipy.fft.ifft2(spectrum, workers=1, overwrite_x=True))


def opencv_ftp(image, _period):
    """OpenCV contrib, structured_light.SinusoidalPattern, method FTP."""
    parameters = cv2.structured_light_SinusoidalPattern_Params()
    parameters.width, parameters.height = image.shape[1], image.shape[0]
    parameters.methodId = cv2.structured_light.FTP
    parameters.setMarkers = False
    pattern = cv2.structured_light.SinusoidalPattern_create(parameters)
    # It reads three images for its shadow mask even here, and ends in a segmentation fault when it gets one.
    answer = pattern.computePhaseMap([image, image, image])
    # atan2(real, imaginary): a quarter of a turn and the sign away.
    return -np.asarray(answer[0], np.float64)


def opencv_ftp_flattened(image, period):
    """The same, helped: it takes the strongest peak for the carrier, which is a body's outline unless the light is flat."""
    light = image.astype(np.float32)
    flat = light - scipy.ndimage.uniform_filter1d(light, 2 * round(period), axis=1)
    scale = 100.0 / max(float(np.abs(flat).max()), 1.0)
    return opencv_ftp(np.clip(128.0 + scale * flat, 0, 255).astype(np.uint8), period)


DEMODULATIONS = {
    "SciPy, Fourier of rows": fourier_rows,
    "SciPy, Fourier in 2-D": fourier_plane,
    "OpenCV FTP": opencv_ftp,
    "OpenCV FTP, light flattened": opencv_ftp_flattened,
}


# Unwrapping.


def skimage_unwrap(wrapped, mask):
    """scikit-image, Herraez' reliability sorting, on the bounding box of the mask."""
    rows, columns = np.where(mask.any(1))[0], np.where(mask.any(0))[0]
    box = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    phase = np.ma.array(np.where(mask, wrapped, 0.0)[box], mask=~mask[box])
    whole = np.full(wrapped.shape, np.nan)
    whole[box] = unwrap_phase(phase).filled(np.nan)
    return whole


def opencv_unwrap(wrapped, mask):
    """OpenCV contrib, HistogramPhaseUnwrapping with a shadow mask."""
    parameters = cv2.phase_unwrapping_HistogramPhaseUnwrapping_Params()
    parameters.width, parameters.height = wrapped.shape[1], wrapped.shape[0]
    unwrapping = cv2.phase_unwrapping.HistogramPhaseUnwrapping_create(parameters)
    filled = np.where(mask, wrapped, 0.0).astype(np.float32)
    result = np.asarray(unwrapping.unwrapPhaseMap(filled, None, mask.astype(np.uint8) * 255), np.float64)
    return np.where(mask, result, np.nan)


UNWRAPPINGS = {"scikit-image unwrap_phase": skimage_unwrap, "OpenCV HistogramPhaseUnwrapping": opencv_unwrap}


# Scores.


def phase_error(found, true, where):
    """Error modulo 2 pi, one constant and the sign, at `where`: NaN elsewhere."""
    best = None
    for sign in (1.0, -1.0):
        difference = wrap(sign * found - true)
        known = where & np.isfinite(difference)
        if not known.any():
            continue
        constant = np.angle(np.exp(1j * difference[known]).mean())
        error = np.where(known, wrap(difference - constant), np.nan)
        # Again about its median: strays must not move the constant.
        error = np.where(known, wrap(error - np.nanmedian(error)), np.nan)
        if best is None or np.nanmedian(np.abs(error)) < np.nanmedian(np.abs(best)):
            best = error
    return best if best is not None else np.full(true.shape, np.nan)


def figures(error, where):
    """RMS, robust spread (1.4826 MAD), 95 %, share beyond 0.3 rad, and share of `where` that has a phase."""
    known = error[where & np.isfinite(error)]
    if known.size == 0:
        keys = ("rms_rad", "robust_rad", "p95_rad", "beyond_0_3_rad_share")
        return dict.fromkeys(keys, float("nan")) | {"coverage": 0.0}
    size = np.abs(known)
    return {
        "rms_rad": float(np.sqrt(np.mean(known**2))),
        "robust_rad": float(1.4826 * np.median(size)),
        "p95_rad": float(np.quantile(size, 0.95)),
        "beyond_0_3_rad_share": float((size > 0.3).mean()),
        "coverage": float(known.size / max(where.sum(), 1)),
    }


def order_share(found, true, where):
    """Share of `where` whose order is right, given the best of all common offsets; unknown ones are not right."""
    orders = np.round((found - true) / TAU)[where]
    known = orders[np.isfinite(orders)].astype(int)
    if known.size == 0:
        return 0.0
    return float(np.bincount(known - known.min()).max() / where.sum())
