"""What a run says about the machine at its start."""

from __future__ import annotations

import logging

from pgfmd.application.machine import available_memory, describe


def levels(found, per_rank):
    """Text of all lines, and of the warnings."""
    lines = describe(found, per_rank)
    return "\n".join(line for _, line in lines), [line for level, line in lines if level == logging.WARNING]


def test_ranks_nodes_and_memory():
    """Six ranks on two nodes are counted per node; the node that has least to spare is the one named."""
    found = 4 * [("fat", set(range(8)), 2, 64e9)] + 2 * [("thin", set(range(8)), 2, 16e9)]
    text, warnings = levels(found, 4e9)
    assert "6 ranks on 2 nodes (fat: 4, thin: 2) × 2 threads" in text
    assert "4 GB per rank, 8 GB on thin of 16 GB" in text and not warnings


def test_warnings():
    """Too little memory and more threads than cores are said beforehand; one thread per rank is never too many."""
    _, warnings = levels(2 * [("node", {0, 1, 2, 3}, 4, 10e9)], 6e9)
    assert len(warnings) == 2 and "memory will not suffice" in warnings[0] and "8 threads on 4 cores" in warnings[1]
    assert not levels([("node", {0, 1}, 2, 10e9), ("node", {2, 3}, 2, 10e9)], 1e9)[1]
    assert not levels(8 * [("node", {0, 1, 2, 3}, 1, 10e9)], 1e9)[1]


def test_available_memory_is_that_of_a_machine():
    """Between 10 MB and 1 PB."""
    assert 1e7 < available_memory() < 1e15
