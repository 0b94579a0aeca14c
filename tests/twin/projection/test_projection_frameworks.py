"""The operator in PyTorch, ODL and (a stand-in of) CIL: their own solvers, unchanged."""

from __future__ import annotations

import cil_stand_in
import numpy as np
import pytest

from flexdt.twin.errors import GeometryError, NotBuiltError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.projection import Operator, Volume
from flexdt.twin.reconstruction.iterative import cgls
from tests.support.device_simulator import run_simulated

SHAPE = (5, 6)
LIKE = Volume(np.zeros((2, 3, 4)), (1.0, 1.2, 0.9), (0.3, -0.2, 0.1))


@pytest.fixture(autouse=True)
def one_thread(one_thread_only):
    """Waking threads would take longer than these small projections."""


@pytest.fixture
def torch():
    return pytest.importorskip("torch", reason="the extra `torch` is not installed")


@pytest.fixture(scope="module")
def scan(circle):
    return circle(
        3, 20, 40, 1.3, roll=0.1, pitch_tilt=0.05, yaw=-0.07, start=0.2, height=1.0
    )


@pytest.fixture
def operator(scan):
    return Operator(scan, LIKE, SHAPE)


def loss_of(siddon, x, rows, data) -> float:
    """Half the sum of squared residuals, in double precision."""
    image = siddon(x, LIKE.voxel_xyz, LIKE.center_mm, ConeVec(rows), SHAPE)
    return 0.5 * float(np.sum((image - data) ** 2))


def slope(function, at: np.ndarray, index: tuple[int, ...], step: float) -> float:
    high, low = at.copy(), at.copy()
    high[index] += step
    low[index] -= step
    return (function(high) - function(low)) / (2 * step)


def test_torch_gradients_of_a_loss(torch, siddon, operator, scan):
    rng = np.random.default_rng(1)
    x, data = rng.uniform(size=LIKE.shape), rng.normal(size=operator.image_shape)
    voxels = torch.tensor(x, requires_grad=True)
    rows = torch.tensor(scan.rows, requires_grad=True)
    residual = operator.torch()(voxels, rows) - torch.tensor(data)
    loss = 0.5 * (residual**2).sum()
    assert float(loss.detach()) == pytest.approx(
        loss_of(siddon, x, scan.rows, data), rel=1e-6
    )
    loss.backward()
    by_voxels, by_rows = voxels.grad.numpy(), rows.grad.numpy()
    for index in [(0, 1, 2), (1, 2, 0), (1, 0, 3)]:
        wanted = slope(lambda v: loss_of(siddon, v, scan.rows, data), x, index, 1e-4)
        assert by_voxels[index] == pytest.approx(
            wanted, abs=1e-5 * np.abs(by_voxels).max()
        )
    for index in [(0, 1), (1, 4), (2, 8), (0, 9), (2, 5)]:
        wanted = slope(lambda r: loss_of(siddon, x, r, data), scan.rows, index, 1e-6)
        assert by_rows[index] == pytest.approx(
            wanted, rel=1e-3, abs=1e-5 * np.abs(by_rows).max()
        )


def test_torch_gradients_of_the_transpose(torch, siddon, operator, scan):
    """<w, A(rows)' y> = <A(rows) w, y>, which the reference computes."""
    rng = np.random.default_rng(2)
    w, y = rng.normal(size=LIKE.shape), rng.normal(size=operator.image_shape)
    rows = torch.tensor(scan.rows, requires_grad=True)
    images = torch.tensor(y, requires_grad=True)
    (operator.torch().T(images, rows) * torch.tensor(w)).sum().backward()
    wanted = siddon(w, LIKE.voxel_xyz, LIKE.center_mm, scan, SHAPE)
    np.testing.assert_allclose(
        images.grad.numpy(), wanted, atol=1e-5 * np.abs(wanted).max()
    )

    def product(r: np.ndarray) -> float:
        return float(
            np.vdot(siddon(w, LIKE.voxel_xyz, LIKE.center_mm, ConeVec(r), SHAPE), y)
        )

    scale = float(rows.grad.abs().max())
    for index in [(0, 0), (1, 3), (2, 11)]:
        wanted = slope(product, scan.rows, index, 1e-6)
        assert float(rows.grad[index]) == pytest.approx(
            wanted, rel=1e-3, abs=1e-5 * scale
        )


@pytest.mark.usefixtures("on_processor")
def test_torch_batches_types_and_errors(torch, operator, scan):
    rng = np.random.default_rng(3)
    x = rng.normal(size=(2, 3, *LIKE.shape)).astype(np.float32)
    project = operator.torch()
    images = project(x)  # a numpy array comes in by DLPack
    assert images.shape == (2, 3, *operator.image_shape)
    assert images.dtype == torch.float32
    for i in range(2):
        for k in range(3):
            assert np.array_equal(np.from_dlpack(images[i, k]), operator @ x[i, k])
    assert np.array_equal((operator @ torch.tensor(x[0, 0])).numpy(), operator @ x[0, 0])
    assert np.array_equal(
        (operator.T @ images[0, 0]).numpy(), operator.T @ images[0, 0].numpy()
    )
    assert project(x[0, :0]).shape == (0, *operator.image_shape)
    # all of the batch shares one geometry, whose derivative is the sum
    rows = torch.tensor(scan.rows, requires_grad=True)
    project(x[0], rows).sum().backward()
    ones = np.ones(operator.image_shape, np.float32)
    wanted = sum(operator.gradient(one, ones) for one in x[0])
    np.testing.assert_allclose(rows.grad.numpy(), wanted, rtol=1e-6, atol=1e-6)
    with pytest.raises(GeometryError, match=r"allowed: \(\.\.\., 2, 3, 4\)"):
        project(torch.zeros(2, 3, 5))
    with pytest.raises(GeometryError, match=r"allowed: \(n, 12\)"):
        project(x[0, 0], torch.zeros(3, 11))
    with pytest.raises(NotBuiltError, match="in the memory of a device"):
        project(torch.zeros(LIKE.shape, device="meta"))


def test_torch_second_derivatives(torch, operator, scan):
    """Newton's step on a quadratic needs A' A v; by geometry there is no second derivative."""
    rng = np.random.default_rng(4)
    x = torch.tensor(rng.normal(size=LIKE.shape), requires_grad=True)
    v = rng.normal(size=LIKE.shape)
    loss = 0.5 * (operator.torch()(x) ** 2).sum()
    (gradient,) = torch.autograd.grad(loss, x, create_graph=True)
    (product,) = torch.autograd.grad((gradient * torch.tensor(v)).sum(), x)
    wanted = operator.T @ (operator @ v)
    np.testing.assert_allclose(product.numpy(), wanted, atol=1e-5 * np.abs(wanted).max())
    rows = torch.tensor(scan.rows, requires_grad=True)
    images = operator.torch()(x.detach(), rows)
    (slopes,) = torch.autograd.grad((images**2).sum(), rows, create_graph=True)
    with pytest.raises(NotBuiltError, match="second derivatives"):
        slopes.sum().backward()


def test_torch_trains_a_network_through_the_projector(torch, operator):
    torch.manual_seed(5)
    truth = torch.rand(4, 1, *LIKE.shape)
    project = operator.torch()
    data = project(truth)
    network = torch.nn.Conv3d(1, 1, 3, padding=1)
    train = torch.optim.Adam(network.parameters(), lr=0.05)
    losses = []
    for _ in range(8):
        train.zero_grad()
        volume = network(project.T(data) / 30)
        loss = ((project(volume) - data) ** 2).mean()
        loss.backward()
        train.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.6 * losses[0]


ON_DEVICE = """
from unittest.mock import Mock
import numpy as np, torch
from numba import cuda
from numba.cuda.simulator.cudadrv.devicearray import FakeCUDAArray
from flexdt.twin.projection import Grid, Operator, gpu
from flexdt.twin.projection import for_torch
from flexdt.twin.projection.kernels import gpu_kernels
from tests.twin.projection.conftest import _circle

# The simulator's arrays are of the host: its tensors stand for those of a device.
gpu_kernels.BLOCK, gpu.LINEAR = (4, 2), 16
assert gpu.availability().present
as_tensor, to_device, moved, waited = torch.as_tensor, cuda.to_device, [], []
for_torch._is_there = lambda tensor: True
cuda.as_cuda_array = lambda tensor: FakeCUDAArray(tensor.numpy())
torch.cuda.current_stream = lambda device: waited.append(device) or Mock()

def shared(x, **options):
    if not hasattr(x, "copy_to_host") and not hasattr(x, "layout"):
        return as_tensor(x, **options)
    flat = x.layout.flat._ary if hasattr(x, "layout") else x._ary
    return torch.from_numpy(np.lib.stride_tricks.as_strided(flat, x.shape, x.strides))

def sent(array, *rest):
    moved.append(array.nbytes)
    return to_device(array, *rest)

def fetched(*_):
    raise AssertionError("an array came back to the host")

torch.as_tensor, cuda.to_device, FakeCUDAArray.copy_to_host = shared, sent, fetched
rng = np.random.default_rng(7)
for counts in ((3, 4, 5), (1, 4, 3), (4, 1, 1)):
    scan, shape = _circle(2, 30.0, 50.0, 1.0, start=0.2, roll=0.1, height=1.0), (4, 3)
    A = Operator(scan, Grid(counts, 0.7, (0.1, -0.2, 0.3)), shape)
    x, y = rng.random((2, *counts)), rng.random((2, *shape), dtype=np.float32)
    with gpu.switched_off():
        exact, spread = np.stack([A @ one for one in x]), A.T @ y
    moved.clear()
    voxels = torch.tensor(x, requires_grad=True)
    rows = torch.tensor(scan.rows, requires_grad=True)
    project = A.torch()
    images = project(voxels)
    assert np.abs(images.detach().numpy() - exact).max() < 3e-6 * exact.max()
    (images[1] * torch.tensor(y)).sum().backward()
    assert not voxels.grad[0].any()
    assert np.abs(voxels.grad[1].numpy() - spread).max() < 3e-6 * spread.max()
    assert set(moved) == {2 * 13 * 8} and len(moved) == 4, moved  # the views, and nothing else
    found = A.T @ torch.tensor(y)  # z is contiguous, so it can be projected as it is
    assert np.abs(found.numpy() - spread).max() < 3e-6 * spread.max()
    pointers = []
    taken, gpu.taken = gpu.taken, lambda a: (pointers.append(a.data_ptr()), taken(a))[1]
    again = A @ found
    gpu.taken = taken
    assert pointers == [found.data_ptr()]
    with gpu.switched_off():
        wanted = A @ spread
    assert np.abs(again.numpy() - wanted).max() < 3e-6 * wanted.max()
    (project(torch.tensor(x[0]), rows) * torch.tensor(y)).sum().backward()
    with gpu.switched_off():
        wanted = A.gradient(x[0], y)
    assert np.allclose(rows.grad.numpy(), wanted, rtol=1e-6)
    assert project(torch.zeros(0, *counts)).shape == (0, 2, *shape)
assert waited
"""


def test_torch_tensors_of_a_device_stay_there(torch):
    run_simulated(ON_DEVICE)


def test_odl_solvers(siddon, operator, scan):
    odl = pytest.importorskip("odl", reason="the extra `odl` is not installed")
    data = np.random.default_rng(6).normal(size=operator.image_shape)
    columns = [
        siddon(unit, LIKE.voxel_xyz, LIKE.center_mm, scan, SHAPE).ravel()
        for unit in np.eye(24).reshape(24, *LIKE.shape)
    ]
    matrix = np.array(columns).T
    wanted = np.linalg.lstsq(matrix, data.ravel(), rcond=None)[0].reshape(LIKE.shape)
    pair = operator.odl()
    low, high = pair.domain.min_pt, pair.domain.max_pt
    np.testing.assert_allclose((high + low)[::-1] / 2, LIKE.center_mm, atol=1e-12)
    np.testing.assert_allclose((high - low)[::-1], LIKE.size_mm)
    right = pair.range.element(data.astype(np.float32))
    x = pair.domain.zero()
    odl.solvers.conjugate_gradient_normal(pair, x, right, niter=40)
    np.testing.assert_allclose(x.asarray(), wanted, atol=1e-3 * np.abs(wanted).max())
    x, omega = pair.domain.zero(), 1.0 / operator.norm() ** 2
    odl.solvers.landweber(pair, x, right, niter=3, omega=omega)
    by_hand = np.zeros(24)
    for _ in range(3):
        by_hand += omega * matrix.T @ (data.ravel() - matrix @ by_hand)
    np.testing.assert_allclose(
        x.asarray().ravel(), by_hand, atol=1e-5 * np.abs(by_hand).max()
    )


@pytest.mark.filterwarnings("default")  # its own
def test_cil_itself(scan):
    pytest.importorskip("cil", reason="CIL is not installed")
    from cil.optimisation.algorithms import CGLS
    from cil.optimisation.operators import LinearOperator as CilOperator

    operator = Operator(scan, LIKE, SHAPE)
    pair = operator.cil()
    assert CilOperator.dot_test(pair)
    assert pair.norm() == pytest.approx(operator.norm(1e-4), rel=0.05)
    data, start = pair.range_geometry().allocate(0), pair.domain_geometry().allocate(0)
    images = operator @ np.random.default_rng(3).uniform(0, 0.05, LIKE.shape)
    data.fill(images)
    solver = CGLS(initial=start, operator=pair, data=data)
    solver.run(5, verbose=0)
    ours = cgls(images, scan, LIKE, iterations=5).data
    np.testing.assert_allclose(
        solver.solution.as_array(), ours, atol=1e-3 * np.abs(ours).max()
    )


@pytest.mark.parametrize("views", [3, 1])
def test_cil_by_its_documented_interface(monkeypatch, scan, views):
    cil_stand_in.install(monkeypatch)
    operator = Operator(scan[:views], LIKE, SHAPE)
    pair = operator.cil()
    assert pair.is_linear()
    assert pair.norm() == pytest.approx(operator.norm(1e-5), rel=1e-3)
    voxels, images = pair.domain_geometry(), pair.range_geometry()
    assert (voxels.sizes["voxel_size_x"], voxels.sizes["voxel_size_y"]) == (1.0, 1.2)
    assert images.pixel == pytest.approx([1.3, 1.3])
    rng = np.random.default_rng(7)
    x, y = voxels.allocate(0), images.allocate(0)
    x.fill(rng.normal(size=LIKE.shape))
    y.fill(rng.normal(size=images.shape))
    assert pair.direct(x).dot(y) == pytest.approx(pair.adjoint(y).dot(x), rel=1e-5)
    given = images.allocate(None)
    assert pair.direct(x, out=given) is given
    assert np.array_equal(
        given.as_array().reshape(operator.image_shape), operator @ x.as_array()
    )
