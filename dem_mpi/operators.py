"""D, M^-1 and N = D^T M^-1 D of a contact set: matrix-free, and assembled in PETSc.

D_i maps the impulse (gamma_n, gamma_1, gamma_2) of contact i to generalised impulses, + on body b,
- on body a. Rows of D^T are this rank's contacts; its columns are bodies, (v, w) each in a scene
with friction or with bodies that are not spheres, and v alone in one of spheres without friction.

Spheres have arms (m, 2) along the normal and inverse inertias (n + g,). General bodies have arms
(m, 6) to the contact point and inverse inertias (n + g, 6) in the world frame: xx, xy, xz, yy, yz,
zz. The shape of the arms tells which loops are used.

Both forms compute the same product; the matrix-free one moves a tenth of the bytes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dem_mpi import _kernels_rigid as rigid
from dem_mpi import _kernels_solver as kernels
from dem_mpi.contacts import ContactSet
from dem_mpi.errors import DemError
from dem_mpi.parallel import Halo, Parallel


class MatrixFree:
    """N = D^T M^-1 D by loops over contacts and bodies.

    Owned: contacts and the first `halo.owned` bodies. Ghost rows of the work arrays are current
    after every `body_velocity`.

    inverse_mass, inverse_inertia : (n + g,) [1/kg] and (n + g,) or (n + g, 6) [1/(kg m^2)];
                                    ghosts current.
    """

    def __init__(
        self,
        contacts: ContactSet,
        inverse_mass: NDArray,
        inverse_inertia: NDArray,
        halo: Halo,
        frictional: bool,
        threads: int = 1,
    ) -> None:
        self.contacts = contacts
        self.halo = halo
        self.columns = 3 if frictional else 1
        bodies = inverse_mass.shape[0]
        self._inverse_mass = inverse_mass
        self._inverse_inertia = inverse_inertia
        self._start = np.zeros(bodies + 1, dtype=np.int64)
        self._second = np.empty(contacts.count, dtype=np.int32)
        kernels.incidence(contacts.b, bodies, self._start, self._second)
        self._world = np.empty((contacts.count, 3))
        self._u = np.zeros((bodies, _freedoms(contacts, frictional)))
        self._momentum: NDArray | None = None
        self._threads = threads
        loops = rigid if _is_general(contacts) else kernels
        self._to_world = kernels.to_world.using(threads)
        self._to_bodies = loops.impulses_to_bodies.using(threads)
        self._to_contacts = loops.bodies_to_contacts.using(threads)

    def body_velocity(self, impulse: NDArray) -> NDArray:
        """Collective. u = M^-1 D impulse, (n + g, 6 or 3); a view that the next call overwrites."""
        c = self.contacts
        self._to_world(c.normal, impulse, self._world)
        self._to_bodies(
            c.normal, c.arm, self._world, c.row, self.halo.owned, self._start, self._second,
            self._inverse_mass, self._inverse_inertia, self._u,
        )  # fmt: skip
        self.halo.reverse_add(self._u)
        self.halo.forward(self._u)
        return self._u

    def contact_velocity(self, u: NDArray, out: NDArray) -> None:
        """out = D^T u for body velocities u (n + g, 6 or 3) with current ghosts."""
        c = self.contacts
        self._to_contacts(c.normal, c.arm, c.a, c.b, u, out)

    def apply(self, impulse: NDArray, out: NDArray) -> None:
        """Collective. out = N impulse."""
        self.contact_velocity(self.body_velocity(impulse), out)

    def body_impulse(self, impulse: NDArray) -> NDArray:
        """Collective. D impulse on owned bodies, (n, 6 or 3); a view that the next call overwrites.

        Columns: impulse [N s], angular impulse [N m s].
        """
        if self._momentum is None:
            self._momentum = np.zeros_like(self._u)
        c = self.contacts
        self._to_world(c.normal, impulse, self._world)
        self._to_bodies(
            c.normal, c.arm, self._world, c.row, self.halo.owned, self._start, self._second,
            *_unit_masses(*self.inverse_masses), self._momentum,
        )  # fmt: skip
        self.halo.reverse_add(self._momentum)
        return self._momentum[: self.halo.owned]

    def relative_velocity(self, u: NDArray, out: NDArray) -> None:
        """Collective. out = D^T u for velocities of the owned bodies u (n, 6 or 3)."""
        self._u[: self.halo.owned] = u
        self.halo.forward(self._u)
        self.contact_velocity(self._u, out)

    def delassus(self) -> Any:
        """Collective. N as a new PETSc matrix; for problems that a direct solver can hold."""
        assembled = Assembled(
            self.contacts, self._inverse_mass, self._inverse_inertia, self.halo,
            self.columns == 3, self.halo.parallel,
        )  # fmt: skip
        matrix = assembled.delassus()
        assembled.destroy()
        return matrix

    @property
    def freedoms(self) -> int:
        """Degrees of freedom of a body, 6 or 3."""
        return self._u.shape[1]

    @property
    def inverse_masses(self) -> tuple[NDArray, NDArray]:
        """Inverse masses (n + g,) and inverse inertias (n + g,) or (n + g, 6)."""
        return self._inverse_mass, self._inverse_inertia

    def diagonal(self) -> NDArray:
        """Return the diagonal of N, (m, columns) [1/kg]."""
        return _diagonal(
            self.contacts, self.columns, self._inverse_mass, self._inverse_inertia, self._threads
        )

    def destroy(self) -> None:
        """Nothing to free: numpy owns all of it."""


class Assembled:
    """D^T and M^-1 as distributed PETSc matrices; N is applied as three products.

    While the contact graph stands, `refill` keeps the pattern and overwrites the values. Raises
    DemError on all ranks if the matrices are larger than PETSc's indices can number.
    """

    def __init__(
        self,
        contacts: ContactSet,
        inverse_mass: NDArray,
        inverse_inertia: NDArray,
        halo: Halo,
        frictional: bool,
        parallel: Parallel,
    ) -> None:
        # Loaded here: a scene that needs no matrices does not pay for PETSc's start and memory.
        from petsc4py import PETSc

        self._petsc = PETSc
        self.contacts = contacts
        self.columns = 3 if frictional else 1
        self._dof = _freedoms(contacts, frictional)
        self.halo = halo
        self._parallel = parallel
        owned = halo.owned
        _check_index_width(parallel, owned * self._dof, contacts.count * self.columns, PETSc)
        first = parallel.exclusive_sum(owned)
        columns = np.zeros(inverse_mass.shape[0], dtype=np.int64)
        columns[:owned] = first + np.arange(owned)
        halo.forward(columns)
        self._first_column = first * self._dof
        self._body_columns = (columns * self._dof).astype(self._petsc.IntType)
        comm = parallel.communicator
        csr = self._rows(contacts)
        sizes = ((contacts.count * self.columns, None), (owned * self._dof, None))
        self.d_transposed = self._petsc.Mat().createAIJ(sizes, csr=csr, comm=comm)
        sizes = ((owned * self._dof, None), (owned * self._dof, None))
        self._body_mass, self._body_inertia = inverse_mass, inverse_inertia
        csr = self._mass_rows(inverse_inertia)
        self.inverse_mass = self._petsc.Mat().createAIJ(sizes, csr=csr, comm=comm)
        self._diag = _diagonal(contacts, self.columns, inverse_mass, inverse_inertia)
        self._gamma, self._g = self.d_transposed.createVecs(side="left"), None
        self._g = self._gamma.duplicate()
        self._w = self.d_transposed.createVecs(side="right")
        self._u = self._w.duplicate()
        self._local = np.zeros((inverse_mass.shape[0], self._dof))

    def refill(self, contacts: ContactSet, inverse_inertia: NDArray | None = None) -> bool:
        """Collective. Take new geometry on the same contact graph; False if the graph changed.

        General bodies turn their inertias with them, and give `inverse_inertia` (n + g, 6) anew.
        """
        same = contacts.same_graph(self.contacts)
        if not self._parallel.min(int(same)):
            return False
        self.contacts = contacts
        indptr, indices, values = self._rows(contacts)
        self.d_transposed.setValuesCSR(indptr, indices, values)
        self.d_transposed.assemble()
        if inverse_inertia is not None:
            self._body_inertia = inverse_inertia
            self.inverse_mass.setValuesCSR(*self._mass_rows(inverse_inertia))
            self.inverse_mass.assemble()
            self._diag = _diagonal(contacts, self.columns, self._body_mass, inverse_inertia)
        return True

    def _rows(self, contacts: ContactSet) -> tuple[NDArray, NDArray, NDArray]:
        general = _is_general(contacts)
        sides = 2 * contacts.count - int(np.count_nonzero(contacts.b < 0))
        if general:
            entries = 6 * self.columns
        else:
            entries = 3 + 2 * 6 if self._dof == 6 else 3
        indptr = np.zeros(contacts.count * self.columns + 1, dtype=self._petsc.IntType)
        indices = np.empty(sides * entries, dtype=self._petsc.IntType)
        values = np.empty(sides * entries)
        write = rigid.assembled_rows if general else kernels.assembled_rows
        write(
            contacts.normal, contacts.arm, contacts.a, contacts.b,
            self.columns if general else self._dof, self._body_columns, indptr, indices, values,
        )  # fmt: skip
        second = contacts.b >= 0
        column = self._body_columns
        if np.any(column[contacts.a[second]] == column[contacts.b[second]]):
            # A body and an image of itself: PETSc would keep one of the two entries of a column.
            return _merged(indptr, indices, values)
        return indptr, indices, values

    def _mass_rows(self, inverse_inertia: NDArray) -> tuple[NDArray, NDArray, NDArray]:
        """Rows of M^-1: diagonal, or for general bodies with a 3 x 3 block for the rotation."""
        owned, dof, index = self.halo.owned, self._dof, self._petsc.IntType
        mass = self._body_mass[:owned]
        if inverse_inertia.ndim == 2:
            indices, values = np.empty((owned, 12), index), np.empty((owned, 12))
            rigid.mass_rows(mass, inverse_inertia, indices, values)
            indices += self._first_column
            lengths = np.tile([1, 1, 1, 3, 3, 3], owned)
            indptr = np.concatenate(([0], np.cumsum(lengths))).astype(index)
            return indptr, indices.ravel(), values.ravel()
        entries = np.empty((owned, dof))
        entries[:, :3] = mass[:, None]
        if dof == 6:
            entries[:, 3:] = inverse_inertia[:owned, None]
        rows = np.arange(owned * dof + 1, dtype=index)
        return rows, (self._first_column + rows[:-1]).astype(index), entries.ravel()

    def body_velocity(self, impulse: NDArray) -> NDArray:
        """Collective. u = M^-1 D impulse, (n + g, 6 or 3); ghosts current."""
        self._gamma.getArray()[:] = impulse.ravel()
        self.d_transposed.multTranspose(self._gamma, self._w)
        self.inverse_mass.mult(self._w, self._u)
        owned = self.halo.owned
        self._local[:owned] = self._u.getArray(readonly=True).reshape(owned, self._dof)
        self.halo.forward(self._local)
        return self._local

    def contact_velocity(self, u: NDArray, out: NDArray) -> None:
        """Collective. out = D^T u for body velocities u, of which the owned rows are read."""
        self._u.getArray()[:] = u[: self.halo.owned].ravel()
        self.d_transposed.mult(self._u, self._g)
        out[:] = self._g.getArray(readonly=True).reshape(out.shape)

    def apply(self, impulse: NDArray, out: NDArray) -> None:
        """Collective. out = N impulse by D^T (M^-1 (D impulse))."""
        self._gamma.getArray()[:] = impulse.ravel()
        self.d_transposed.multTranspose(self._gamma, self._w)
        self.inverse_mass.mult(self._w, self._u)
        self.d_transposed.mult(self._u, self._g)
        out[:] = self._g.getArray(readonly=True).reshape(out.shape)

    def body_impulse(self, impulse: NDArray) -> NDArray:
        """Collective. D impulse on owned bodies, (n, 6 or 3) [N s, N m s]."""
        self._gamma.getArray()[:] = impulse.ravel()
        self.d_transposed.multTranspose(self._gamma, self._w)
        return self._w.getArray(readonly=True).reshape(self.halo.owned, self._dof)

    def relative_velocity(self, u: NDArray, out: NDArray) -> None:
        """Collective. out = D^T u for velocities of the owned bodies u (n, 6 or 3)."""
        self.contact_velocity(u, out)

    def delassus(self) -> Any:
        """Collective. N = D^T M^-1 D as a new PETSc matrix."""
        D = self.d_transposed.transpose(self._petsc.Mat())
        matrix = self.inverse_mass.ptap(D)
        D.destroy()
        return matrix

    @property
    def freedoms(self) -> int:
        """Degrees of freedom of a body, 6 or 3."""
        return self._dof

    @property
    def inverse_masses(self) -> tuple[NDArray, NDArray]:
        """Inverse masses (n + g,) and inverse inertias (n + g,) or (n + g, 6)."""
        return self._body_mass, self._body_inertia

    def diagonal(self) -> NDArray:
        """Return the diagonal of N, (m, columns) [1/kg]."""
        return self._diag

    def destroy(self) -> None:
        """Collective. Free every PETSc object this operator made."""
        for item in (self.d_transposed, self.inverse_mass, self._gamma, self._g, self._w, self._u):
            item.destroy()


def world_inverse_inertia(axis: NDArray, inverse_inertia: NDArray, threads: int = 1) -> NDArray:
    """Return (n, 6) in the world frame from (n, 2), across and along the unit `axis` (n, 3)."""
    world = np.empty((len(axis), 6))
    rigid.world_inverse_inertia.using(threads)(axis, inverse_inertia, world)
    return world


def _is_general(contacts: ContactSet) -> bool:
    """Whether bodies may be other than spheres."""
    return contacts.arm.shape[1] == 6


def _freedoms(contacts: ContactSet, frictional: bool) -> int:
    """Degrees of freedom of a body: 3 only where no contact can turn it."""
    return 6 if frictional or _is_general(contacts) else 3


def _merged(indptr: NDArray, indices: NDArray, values: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Rows with entries of the same column added up."""
    from scipy import sparse  # rarely needed: periods are longer than bodies in a simulation

    width = int(indices.max(initial=-1)) + 1
    rows = sparse.csr_matrix((values, indices, indptr), shape=(len(indptr) - 1, width))
    rows.sum_duplicates()
    return rows.indptr.astype(indptr.dtype), rows.indices.astype(indices.dtype), rows.data


def _unit_masses(inverse_mass: NDArray, inverse_inertia: NDArray) -> tuple[NDArray, NDArray]:
    """Masses and inertias of one, with which loops for M^-1 D give D itself."""
    unit = np.ones_like(inverse_inertia)
    if unit.ndim == 2:
        unit[:] = (1.0, 0.0, 0.0, 1.0, 0.0, 1.0)
    return np.ones_like(inverse_mass), unit


def _diagonal(
    c: ContactSet, columns: int, inverse_mass: NDArray, inverse_inertia: NDArray, threads: int = 1
) -> NDArray:
    """Return the diagonal of N, (m, columns) [1/kg]."""
    diag = np.empty((c.count, columns))
    bodies = (c.a, c.b, inverse_mass, inverse_inertia, diag)
    if _is_general(c):
        rigid.diagonal.using(threads)(c.normal, c.arm, *bodies)
    else:
        kernels.diagonal.using(threads)(c.arm, *bodies)
    return diag


def _check_index_width(parallel: Parallel, columns: int, rows: int, petsc: Any) -> None:
    """Collective. Raise DemError if the ranks' columns or rows outnumber PETSc's index type."""
    largest = int(parallel.sum(np.array([columns, rows], dtype=np.int64)).max())
    width = np.iinfo(petsc.IntType)
    if largest > width.max:
        raise DemError(
            f"{largest} matrix rows or columns are more than PETSc's {width.bits}-bit indices can "
            f"number: use a PETSc with 64-bit indices, or contact.operator: matrix_free"
        )
