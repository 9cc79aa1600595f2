"""The same clouds in Mitsuba 3, for benchmarks/splat.py: its `volprim_rf_basic` integrator in the LLVM variant.

It takes `pip install mitsuba` (3.9.1 was measured) and the shared library of LLVM, which Dr.Jit loads: on Debian 12
`apt-get install libllvm19`, elsewhere set the environment variable DRJIT_LIBLLVM_PATH to a libLLVM.so. With LLVM 15 the
process ends with "Cannot select: fminimum" on processors with AVX-512. Dr.Jit keeps compiled kernels on disk, so
compile times, which hold a first pass, are true only for the first run on a machine.

Its model is another one: rays meet ellipsoids in the order of their surfaces, a Gaussian is evaluated at its largest
along the ray, without the blur of 0.3 square pixels, within three standard deviations, and a ray ends at a
transmittance of 0.01 or after 64 ellipsoids. So pictures agree only roughly.
"""

from __future__ import annotations

import drjit as dr  # pyright: ignore[reportMissingImports]
import mitsuba as mi  # pyright: ignore[reportMissingImports]
import numpy as np

from avatarjax import Camera, Gaussians

# Value of the spherical harmonic of degree 0; Mitsuba adds 0.5 to the sum.
_SH_0 = 0.28209479177387814

mi.set_variant("llvm_ad_rgb")


class Renderer:
    """A cloud of n Gaussians as ellipsoids, a camera, and an integrator; the search structure is built once, here."""

    def __init__(self, cloud: Gaussians, camera: Camera) -> None:
        quats = np.asarray(cloud.quats)
        arrays = {
            "centers": cloud.means,
            "scales": cloud.scales,
            "quaternions": np.roll(quats / np.linalg.norm(quats, axis=1, keepdims=True), -1, axis=1),
            "opacities": cloud.opacities[:, None],
            "sh_coeffs": (cloud.colors - 0.5) / _SH_0,
        }
        ellipsoids = {name: mi.TensorXf(np.asarray(array, np.float32)) for name, array in arrays.items()}
        # Mitsuba's camera looks along +z as ours does, but its x is left and its y is up.
        camera_to_world = np.linalg.inv(np.asarray(camera.world_to_camera, np.float64)) @ np.diag([-1, -1, 1, 1])
        focal = float(camera.intrinsics[1, 1])
        self._scene = mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "volprim_rf_basic", "srgb_primitives": False},
                "sensor": {
                    "type": "perspective",
                    "fov_axis": "y",
                    "fov": float(np.degrees(2 * np.arctan(0.5 * camera.height / focal))),
                    "to_world": mi.ScalarTransform4f(camera_to_world),
                    # One ray through the centre of each pixel, and no blur between pixels.
                    "sampler": {"type": "stratified", "sample_count": 1, "jitter": False},
                    "film": {
                        "type": "hdrfilm",
                        "width": camera.width,
                        "height": camera.height,
                        "pixel_format": "rgb",
                        "component_format": "float32",
                        "rfilter": {"type": "box"},
                    },
                },
                "ellipsoids": {"type": "ellipsoids", **ellipsoids},
            }
        )
        self._parameters = mi.traverse(self._scene)
        self._trained = [f"ellipsoids.{name}" for name in ("data", "opacities", "sh_coeffs")]

    def image(self) -> mi.TensorXf:
        """Image (h, w, 3) over black, computed when it returns."""
        image = mi.render(self._scene, spp=1)
        dr.eval(image)
        dr.sync_thread()
        return image

    def gradient(self, weights: np.ndarray) -> list[mi.Float]:
        """Gradient of sum(image * weights), weights (h, w, 3).

        Three flat arrays: for centres, scales and quaternions; for opacities; for spherical harmonics.
        """
        for name in self._trained:
            dr.enable_grad(self._parameters[name])
            dr.clear_grad(self._parameters[name])
        image = mi.render(self._scene, self._parameters, spp=1)
        dr.backward(dr.sum(image * mi.TensorXf(weights), axis=None))
        gradient = [dr.grad(self._parameters[name]) for name in self._trained]
        dr.eval(gradient)
        dr.sync_thread()
        for name in self._trained:
            dr.disable_grad(self._parameters[name])
        return gradient


def release() -> None:
    """Give the memory that Dr.Jit keeps for reuse back to the system."""
    dr.sync_thread()
    dr.flush_malloc_cache()
