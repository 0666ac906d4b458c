"""Frames along a line against the helix's closed forms."""

from __future__ import annotations

import numpy as np

from endopilot.anatomy.tree import parallel_transport, tangents

A_MM, B_MM = 8.0, 2.0
SPEED = np.hypot(A_MM, B_MM)


def helix(step_mm: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    angle = np.arange(0.0, 4 * np.pi, step_mm / SPEED)
    points = np.stack([A_MM * np.cos(angle), A_MM * np.sin(angle), B_MM * angle], axis=1)
    return angle, points


def test_normals_turn_against_the_frenet_frame_by_the_integral_of_torsion():
    angle, points = helix()
    normals, direction = parallel_transport(points), tangents(points)
    frenet = -np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    binormal = np.cross(direction, frenet)
    turned = np.unwrap(np.arctan2(np.einsum("ij,ij->i", normals, binormal), np.einsum("ij,ij->i", normals, frenet)))
    expected = -B_MM / SPEED**2 * SPEED * angle
    assert np.abs((turned - turned[0] - expected)[2:-2]).max() < 0.01
    assert np.abs(np.einsum("ij,ij->i", normals, direction)).max() < 1e-12
    assert np.abs(np.linalg.norm(normals, axis=1) - 1.0).max() < 1e-12


def test_tangents_are_exact_to_second_order_up_to_both_ends():
    angle, points = helix()
    exact = np.stack([-A_MM * np.sin(angle), A_MM * np.cos(angle), np.full(len(angle), B_MM)], axis=1) / SPEED
    assert np.linalg.norm(tangents(points) - exact, axis=1).max() < 2e-3
