"""The modes of a clamped steel beam from scratch: mesh, stiffness, mass and modes by scikit-fem, then a picture.

Usage: python beam.py [ADDRESS]. Without ADDRESS, it starts a server. Writes beam.png.
"""

import sys

import numpy as np
import skfem
from scipy.sparse.linalg import eigsh
from skfem.helpers import dot
from skfem.models.elasticity import lame_parameters, linear_elasticity

import modalcast as mc

SIZE = (4.0, 0.5, 0.2)  # length, width and height in meters; z is up
YOUNGS_MODULUS, POISSONS_RATIO, DENSITY = 210e9, 0.3, 7850.0  # steel, in Pa, 1 and kg/m^3
COLORS = [(0.80, 0.25, 0.10), (0.85, 0.55, 0.08), (0.10, 0.42, 0.55), (0.30, 0.16, 0.45)]  # one beam per mode
TIPS = np.array([0.8, -0.6, 0.7, 0.2])  # largest displacement of each beam in meters


def surface(mesh: skfem.MeshTet) -> np.ndarray:
    """The triangles of the boundary, counterclockwise seen from outside."""
    boundary = mesh.boundary_facets()
    triangles = np.asarray(mesh.facets)[:, boundary].T
    a, b, c = (mesh.p[:, corner] for corner in triangles.T)
    inside = mesh.p[:, mesh.t[:, np.asarray(mesh.f2t)[0, boundary]]].mean(axis=1)
    is_inward = (np.cross(b - a, c - a, axis=0) * (a - inside)).sum(axis=0) < 0
    return np.where(is_inward[:, None], triangles[:, ::-1], triangles)


def modes(mesh: skfem.MeshTet, count: int) -> tuple[np.ndarray, np.ndarray]:
    """U (3n x r) with U^T M U = I for a beam that is clamped at x = 0, and the eigenvalues in (rad/s)^2."""
    basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementTetP2()))
    stiffness = linear_elasticity(*lame_parameters(YOUNGS_MODULUS, POISSONS_RATIO)).assemble(basis)
    mass = skfem.BilinearForm(lambda u, v, _: DENSITY * dot(u, v)).assemble(basis)
    free = basis.complement_dofs(basis.get_dofs(lambda x: x[0] == 0))
    eigenvalues, columns = eigsh(stiffness[free][:, free], count, mass[free][:, free], sigma=0)
    U = np.zeros((basis.N, count))
    U[free] = columns * np.sign(columns[np.abs(columns).argmax(axis=0), range(count)])  # largest entries are positive
    return U[np.asarray(basis.nodal_dofs).T.ravel()], eigenvalues  # rows of vertices, without those of edges


mesh = skfem.MeshTet.init_tensor(*(np.linspace(0, side, count) for side, count in zip(SIZE, (33, 5, 3), strict=True)))
faces = surface(mesh)
U, eigenvalues = modes(mesh, len(COLORS))
print("Frequencies in Hz:", np.round(np.sqrt(eigenvalues) / (2 * np.pi), 1))
builder = mc.SceneBuilder("beams", up="z")
for mode, color in enumerate(COLORS):
    placement = np.eye(4) + np.outer((0, 1.5 * mode, 1.2, 0), (0, 0, 0, 1))
    builder.add(mesh.p.T, faces, U, name=f"mode {mode + 1}", eigenvalues=eigenvalues, placement=placement, color=color)
wall = skfem.MeshTet().scaled((0.4, 6.0, 1.6)).translated((-0.4, -0.5, 0.5))
builder.add(wall.p.T, surface(wall), name="wall", color=(0.5, 0.5, 0.5))
with mc.connect(sys.argv[1]) if len(sys.argv) > 1 else mc.spawn() as client:
    scene = client.upload(builder, replace=True)
    amplitudes = TIPS / np.linalg.norm(U.reshape(-1, 3, len(TIPS)), axis=1).max(axis=0)
    with scene.drive() as drive:
        drive.step(q={f"mode {mode + 1}": q for mode, q in enumerate(np.diag(amplitudes))})
    camera = mc.look_at(eye=(11.5, -5.0, 6.0), target=(1.9, 2.0, 1.05), field_of_view=20)
    scene.frame(camera).save("beam.png")
