import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from lp_framework.data.real_cameras import (
    ObjectFrame,
    crop_field_of_view,
    crop_homography,
    effective_radii,
    from_pytorch3d,
    ndc_intrinsics,
    perspective_residual,
    project,
    spherical_camera,
    turn_towards_centre,
    z_up_to_y_up,
)
from lp_framework.data.views import FIELD_OF_VIEW_DEGREES
from lp_framework.geometry import (
    camera_to_world,
    from_opencv,
    inverse,
    rigid_transform,
    se3_exp,
    so3_exp,
    spherical_residual,
    view_pose,
)

BOX = torch.cartesian_prod(*[torch.tensor([-0.5, 0.5], dtype=torch.float64)] * 3) * torch.tensor([1.0, 0.6, 0.3])


def real_camera(seed: int, distance: float = 5.0, turn: float = 0.4) -> tuple[torch.Tensor, torch.Tensor]:
    """A camera that stands and is turned at random, about towards the origin, with its own intrinsics."""
    random = torch.Generator().manual_seed(seed)
    latitude, longitude, x, y, z, f, cx, cy = torch.rand(8, generator=random, dtype=torch.float64).tolist()
    pose = torch.tensor([2.8 * (latitude - 0.5), 2 * math.pi * longitude, distance], dtype=torch.float64)
    camera = camera_to_world(pose)
    off = so3_exp(turn * (2 * torch.tensor([x, y, 5 * z], dtype=torch.float64) - torch.tensor([1.0, 1.0, 5.0])))
    intrinsics = torch.tensor([[600 + 400 * f, 0.0, 300 + 50 * cx], [0.0, 620 + 380 * f, 200 + 50 * cy], [0, 0, 1]])
    return rigid_transform(camera[:3, :3] @ off, camera[:3, 3]), intrinsics.double()


def mapped(homography: torch.Tensor, pixels: torch.Tensor) -> torch.Tensor:
    points = torch.cat([pixels, torch.ones_like(pixels[:, :1])], dim=-1) @ homography.mT
    return points[:, :2] / points[:, 2:]


# ---------------------------------------------------------------- conventions


@given(st.integers(0, 10**6))
@settings(max_examples=30, deadline=None)
def test_opencv_cameras_project_as_opencv_does(seed):
    camera, intrinsics = real_camera(seed)
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
    world_to_camera = flip @ inverse(camera)
    torch.testing.assert_close(from_opencv(inverse(world_to_camera)), camera, rtol=0, atol=1e-12)
    seen = BOX @ world_to_camera[:3, :3].mT + world_to_camera[:3, 3]
    pixels = seen @ intrinsics.mT
    torch.testing.assert_close(project(camera, intrinsics, BOX), pixels[:, :2] / pixels[:, 2:], rtol=1e-10, atol=1e-8)


@pytest.mark.parametrize("isotropic", [True, False])
@pytest.mark.parametrize("size", [(640, 400), (300, 700)])
def test_pytorch3d_cameras_project_as_pytorch3d_does(isotropic, size):
    # PyTorch3D: X_camera = X R + T, x left and y up; ndc = f * x / z + p, the middle of the image at 0, and +1 on the
    # left and upper edge (of the shorter side, or of either).
    rigid = se3_exp(torch.tensor([0.2, -0.1, 4.0, 0.4, 2.5, -0.3], dtype=torch.float64))
    rotation, translation = rigid[:3, :3].mT, torch.tensor([0.2, -0.1, 4.0], dtype=torch.float64)
    focal, principal = torch.tensor([[2.1, 2.3], [0.05, -0.1]], dtype=torch.float64)
    seen = BOX @ rotation + translation
    ndc = focal * seen[:, :2] / seen[:, 2:] + principal
    width, height = size
    half = torch.tensor([min(size), min(size)] if isotropic else size, dtype=torch.float64) / 2
    expected = torch.stack([width / 2 - ndc[:, 0] * half[0], height / 2 - ndc[:, 1] * half[1]], dim=-1)
    camera, intrinsics = from_pytorch3d(rotation, translation), ndc_intrinsics(focal, principal, size, isotropic)
    torch.testing.assert_close(project(camera, intrinsics, BOX), expected, rtol=1e-10, atol=1e-8)


def test_a_world_with_z_up_is_turned_not_mirrored():
    camera, _ = real_camera(3)
    turned = z_up_to_y_up(camera)
    assert torch.linalg.det(turned[:3, :3]) == pytest.approx(1)
    azimuth, elevation = 0.7, 0.3
    stands = torch.tensor(
        [math.cos(azimuth) * math.cos(elevation), math.sin(azimuth) * math.cos(elevation), math.sin(elevation)]
    )
    latitude, longitude, radius = view_pose(z_up_to_y_up(rigid_transform(torch.eye(3), stands))).tolist()
    assert (latitude, longitude, radius) == pytest.approx((elevation, azimuth, 1.0))


def test_normalising_the_frame_changes_no_image():
    camera, intrinsics = real_camera(5)
    centre, side = torch.tensor([0.3, -2.0, 1.0], dtype=torch.float64), 37.0
    placed = rigid_transform(camera[:3, :3], camera[:3, 3] * side + centre)
    frame = ObjectFrame(torch.eye(3, dtype=torch.float64), centre, torch.tensor(side), torch.ones(3))
    torch.testing.assert_close(frame.camera(placed), camera, rtol=0, atol=1e-12)
    pixels = project(placed, intrinsics, BOX * side + centre)
    torch.testing.assert_close(pixels, project(camera, intrinsics, BOX), rtol=1e-9, atol=1e-7)


# ---------------------------------------------------------------- turn and crop


@given(st.integers(0, 10**6))
@settings(max_examples=50, deadline=None)
def test_the_turned_camera_is_spherical_at_the_same_place(seed):
    camera, _ = real_camera(seed)
    turned, angle = turn_towards_centre(camera)
    assert spherical_residual(turned) < 1e-9
    assert torch.equal(turned[:3, 3], camera_to_world(view_pose(camera))[:3, 3])
    torch.testing.assert_close(turned[:3, 3], camera[:3, 3], rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(angle, spherical_residual(camera), rtol=0, atol=1e-9)


@given(st.integers(0, 10**6), st.floats(1.5, 30), st.floats(1.2, 2.0))
@settings(max_examples=50, deadline=None)
def test_the_crop_is_the_turned_cameras_image_exactly(seed, distance, radius):
    camera, intrinsics = real_camera(seed, distance, turn=0.15)
    size = 512
    homography = crop_homography(camera, intrinsics, torch.tensor(radius, dtype=torch.float64), size)
    turned, _ = turn_towards_centre(camera)
    focal = size / 2 / (radius / distance * math.tan(math.radians(FIELD_OF_VIEW_DEGREES) / 2))
    crop = torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]], dtype=torch.float64)
    seen, photographed = project(turned, crop, BOX), project(camera, intrinsics, BOX)
    torch.testing.assert_close(mapped(homography, seen), photographed, rtol=1e-9, atol=1e-7)
    middle = torch.tensor([[size / 2, size / 2]], dtype=torch.float64)
    centre = project(camera, intrinsics, torch.zeros(1, 3, dtype=torch.float64))
    torch.testing.assert_close(mapped(homography, middle), centre, rtol=1e-10, atol=1e-8)


@given(st.integers(0, 10**6), st.floats(1.2, 2.0))
@settings(max_examples=30, deadline=None)
def test_the_residual_is_zero_if_the_effective_radius_is_the_distance(seed, radius):
    camera, _ = real_camera(seed, distance=radius)
    radius = torch.tensor(radius, dtype=torch.float64)
    assert crop_field_of_view(radius, radius).item() == pytest.approx(math.radians(FIELD_OF_VIEW_DEGREES))
    assert perspective_residual(camera, radius, BOX) < 1e-12


def test_in_the_centre_plane_the_crop_is_the_spherical_cameras_image():
    camera, _ = real_camera(11, distance=9.0)
    right_and_up = turn_towards_centre(camera)[0][:3, :2]
    plane = torch.tensor([[0.3, 0.2], [-0.4, 0.1], [0.0, -0.5]], dtype=torch.float64) @ right_and_up.mT
    assert perspective_residual(camera, torch.tensor(1.6, dtype=torch.float64), plane) < 1e-12


def test_the_residual_grows_with_the_change_of_distance_and_is_bounded_far_away():
    residuals = [
        perspective_residual(real_camera(1, distance)[0], torch.tensor(1.6, dtype=torch.float64), BOX).item()
        for distance in (1.6, 2.0, 3.0, 6.0, 20.0, 1000.0)
    ]
    assert residuals == sorted(residuals) and residuals[0] < 1e-12
    assert 0 < residuals[-1] - residuals[-2] < 0.01 and residuals[-1] < 0.2


def test_a_camera_inside_the_object_has_no_finite_residual():
    camera, _ = real_camera(2, distance=0.2)
    assert perspective_residual(camera, torch.tensor(1.2, dtype=torch.float64), BOX).isinf()


def test_the_spherical_camera_stands_in_the_same_direction():
    camera, _ = real_camera(7)
    pose = view_pose(spherical_camera(camera, torch.tensor(1.3, dtype=torch.float64)))
    torch.testing.assert_close(pose[:2], view_pose(camera)[:2], rtol=0, atol=1e-12)
    assert pose[2].item() == pytest.approx(1.3)


@given(st.lists(st.floats(0.5, 100), min_size=1, max_size=30))
@settings(max_examples=50, deadline=None)
def test_effective_radii_keep_order_and_range(distances):
    distances = torch.tensor(distances, dtype=torch.float64)
    radii = effective_radii(distances)
    assert radii.min() >= 1.2 and radii.max() <= 2.0
    assert (radii[distances.argsort()].diff() >= 0).all()
    inside = (radii > 1.2) & (radii < 2.0)
    ratio = radii[inside] / distances[inside]
    torch.testing.assert_close(ratio, ratio[:1].expand_as(ratio))
    torch.testing.assert_close(effective_radii(distances * 7.0), radii)
