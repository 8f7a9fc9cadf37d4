"""Records of programs that no browser test can open: engines, native programs, and pages without a package. They are read only."""

from __future__ import annotations

import math
from dataclasses import replace

from mipmap_plugin.effects import NEAR_PLANE
from mipmap_plugin.render_settings import FRUSTUM_MARGIN, Packing, RenderSettings
from mipmap_plugin.screen_filters import DILATION
from mipmap_plugin.splatting.viewer import NONE_OR_3, UP_TO_3, WEBGL, Viewer

UNSEEN = "; not compared with its images"

# web-splat's fragment shader ends a splat where r²/2 = 2·sqrt(ln 255), in standard deviations.
WEB_SPLAT_EDGE = 2 * math.log(255) ** 0.25

WEB_SPLAT = replace(WEBGL, radius=WEB_SPLAT_EDGE, max_alpha=0.99, frame=1.2)
HALF = (
    "centers are rounded to float16 from -1 to 1 across the picture, to a quarter of a pixel at the edges of one of 1000 px; covariances are "
    "stored in float16, in world units: of widths below 2e-4 little is left"
)

# px²: GDGS draws no splat whose mean variance is below the root of 0.1. That along the longer axis is then 0.316 (round) to 0.332 (a needle).
GODOT_LEAST = 2 * 0.1**0.5 - DILATION

UNITY = Viewer(
    "unity", "UnityGaussianSplatting (aras-p)", "UnityGaussianSplatting 1.1.1 (2c6fed3), RenderGaussianSplats, GaussianSplatting.hlsl",
    "classic", DILATION,
    # Along y its limit of the Jacobian is that along x, and both are taken from the axis of view.
    replace(WEBGL, min_alpha=1 / 255, frozen_beyond=FRUSTUM_MARGIN, frozen_by_width=True, max_half_axis=8192.0, picture_step=None),
    read_degrees=NONE_OR_3, extra_columns=False,
    unlike="a splat ends at a square instead of an ellipse, assets are packed at the quality chosen on import, and the background shines "
    "through in linear light" + UNSEEN,
)  # fmt: skip

BRUSH = Viewer(
    "brush", "Brush", "brush 8b7f5c6c, brush-render, for a file without SplatRenderMode mip", "classic", DILATION,
    RenderSettings(max_alpha=0.999), near_plane=0.01, sh_degree=4, unlike="a file with SplatRenderMode mip is drawn as mip" + UNSEEN,
)  # fmt: skip

GSPLAT = "gsplat 1.6.0 (90d7b4b), rendering, gsplat_viewer, Common.h; nerfstudio 50e0e3c, splatfacto"

# LichtFeld Studio's least alpha, at which an opaque splat ends.
LICHTFELD_ALPHA = 0.5 / 255

# Those that `portable` leaves out: but for MetalSplatter it suits them without, and with them its start would be that of dilation by 0.3 px² instead
# of 0.075: the worst viewer of lego at x1/4 would have 3.3 dB less, the mean 2.7 (docs/viewers.md).
FURTHER = (
    Viewer(
        "gsplat", "gsplat, nerfstudio", GSPLAT, "classic", DILATION, near_plane=0.01, sh_degree=4,
        unlike="a splat ends at 3.33 standard deviations; until gsplat 1.5 its largest alpha was 0.999",
    ),
    Viewer(
        "gsplat-antialiased", "gsplat, nerfstudio, their mode antialiased", GSPLAT, "antialiased", DILATION, near_plane=0.01, sh_degree=4,
        unlike="as gsplat; until gsplat 1.5 its compensation had no lower bound",
    ),
    Viewer(
        "3dgs.cpp", "3DGS.cpp", "3DGS.cpp f614d66, GSScene.cpp and shaders", "classic", DILATION, near_plane=NEAR_PLANE, read_degrees=(3,),
        extra_columns=False, unlike="a splat ends at three standard deviations, rounded up to tiles" + UNSEEN,
    ),
    Viewer(
        "lichtfeld", "LichtFeld Studio",
        "LichtFeld-Studio of 2026, rendering/rasterizer/vulkan: config a194d705, vertex_shader 0241ebb7, utils 0232ecb1, alphablend_shader 1cbe0678",
        "classic", DILATION,
        RenderSettings(
            min_alpha=LICHTFELD_ALPHA, max_alpha=0.999, radius=(-2 * math.log(LICHTFELD_ALPHA)) ** 0.5, max_half_axis=512.5, max_color=4.0, frame=1.4,
        ),
        near_plane=0.01,
        read_degrees=UP_TO_3, extra_columns=False,
        unlike="with its mip filter it is Mip-Splatting's; fainter splats may be up to a quarter longer; October 2025 (0ff1dc2) it drew as Brush does"
        + UNSEEN,
    ),
    Viewer(
        "vk-gaussian-splatting", "NVIDIA's vk_gaussian_splatting",
        "vk_gaussian_splatting 2026.1.6 (fb89d09), threedgs shaders, dist.comp, parameters.h", "classic", DILATION,
        # 16 bits a channel, from the back; SH coefficients within -1..1 in 255 steps.
        replace(
            WEBGL, min_alpha=1 / 255, frame=1.2, max_half_axis=2048.0, least_spread=0.1**0.5, level_below=1e-3,
            packing=Packing(color=1 / 255, bands=(2 / 255,) * 3), picture_step=None,
        ),
        read_degrees=NONE_OR_3,
        unlike="as its rasterizer of 3DGS draws with the settings that it starts with, not 3DGUT or ray tracing; with mip-splatting antialiasing it "
        "compensates; upright splats that are not stretched are turned, too, where |xy| is below 0.001 px²" + UNSEEN,
    ),
    Viewer(
        # The minimum distance of variances from their mean is 0.1 here, where GaussianSplats3D has its root.
        "metalsplatter", "MetalSplatter (Apple)", "MetalSplatter 1.0.1 (71ff248), SplatProcessing.metal, SplatRenderer", "classic", DILATION,
        replace(WEBGL, radius=3.0, frame=1.2, least_spread=0.1, radial=True, frozen_beyond=FRUSTUM_MARGIN, linear_light=2.2, picture_step=None),
        read_degrees=NONE_OR_3,
        unlike="covariances and colors are stored in float16, and the picture has 8 bits of sRGB" + UNSEEN,
    ),
    Viewer(
        # It has no least alpha; splats end at tiles of 16 px.
        "gdgs", "GDGS and GodotGaussianSplatting (Godot)",
        "godot-gaussian-splatting 2.1.0 (43a8b43) and 2Retr0/GodotGaussianSplatting 181ef73, gsplat_projection and gsplat_render",
        "classic", DILATION,
        RenderSettings(min_alpha=1e-3, max_alpha=0.999, min_transmittance=1 / 255, frame=1.2, min_variance=GODOT_LEAST),
        read_degrees=(3,), extra_columns=False,  # GDGS reads degree 0, and such columns, too
        unlike="the picture is shrunk by a pixel, so that it is half a pixel off at its edges; depths have 16 bits; the background shines through in "
        "linear light" + UNSEEN,
    ),
    Viewer(
        "web-splat", "web-splat (KeKsBoTer)", "web-splat 959a3ec, preprocess.wgsl, gaussian.wgsl, renderer.rs", "classic", DILATION, WEB_SPLAT,
        read_degrees=UP_TO_3, extra_columns=False,
        unlike=f"{HALF}; a file whose header says mip=true is drawn with compensation, and kernel_size= is its dilation" + UNSEEN,
    ),
    Viewer(
        "visionary", "Visionary", "visionary-core 1.0.1 (c5d7070), preprocess.wgsl, gaussian.wgsl, point_cloud.ts", "classic", 0.1, WEB_SPLAT,
        read_degrees=NONE_OR_3, extra_columns=False,
        unlike=f"splats of an opacity below 0.02 are left out; {HALF}, and so are means" + UNSEEN,
    ),
    Viewer(
        # Its near plane is at 0.1, and it draws nothing whose depth is there below 0.25 of -1..1.
        "splatapult", "Splatapult", "splatapult e87960f, splat and presort shaders, app.cpp", "classic", DILATION,
        replace(WEBGL, min_alpha=1 / 256, radius=3.5, frame=1.5), near_plane=0.1 * 2 / 0.75,
        read_degrees=NONE_OR_3,
        unlike="in VR splats are blended in linear light" + UNSEEN,
    ),
    Viewer(
        # A splat's square ends at 3 standard deviations along x and along y.
        "kiri", "KIRI's 3DGS Render, an add-on for Blender (its viewport)",
        "3dgs-render-blender-addon 4.1.5 (a753a5d), vert.glsl, frag.glsl, composite_frag.glsl, __init__.py", "classic", DILATION,
        replace(WEBGL, min_alpha=1 / 255, max_alpha=0.99, radius=3.0, frame=1.3, max_color=1.0),
        read_degrees=(1, 2, 3),
        unlike="view-dependent colors are those seen from another place, for it takes the view matrix's translation for the camera's center; what is "
        "half covered is darker, and the background shines through in linear light; pictures that it renders to files are rounded once, and their "
        "colors not limited" + UNSEEN,
    ),
)  # fmt: skip
