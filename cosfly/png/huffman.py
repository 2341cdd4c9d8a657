"""Huffman codes of deflate (RFC 1951): the numbers of its tables, codes for writing, tables for reading."""

from __future__ import annotations

import numpy as np

from cosfly.compiled import njit

BASE_LENGTH = np.array([3, 4, 5, 6, 7, 8, 9, 10, 11, 13, 15, 17, 19, 23, 27, 31, 35, 43, 51, 59, 67, 83, 99, 115, 131, 163, 195, 227, 258], np.int64)  # fmt: skip
MORE_LENGTH = np.array([0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3, 4, 4, 4, 4, 5, 5, 5, 5, 0], np.int64)  # fmt: skip
BASE_WAY = np.array([1, 2, 3, 4, 5, 7, 9, 13, 17, 25, 33, 49, 65, 97, 129, 193, 257, 385, 513, 769, 1025, 1537, 2049, 3073, 4097, 6145, 8193, 12289, 16385, 24577], np.int64)  # fmt: skip
MORE_WAY = np.array([0, 0, 0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5, 6, 6, 7, 7, 8, 8, 9, 9, 10, 10, 11, 11, 12, 12, 13, 13], np.int64)  # fmt: skip
LENGTH_ORDER = np.array([16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15], np.int64)


@njit(cache=True, nogil=True)
def code_lengths(counts, most):  # type: ignore[no-untyped-def]
    """Lengths of the best code for symbols of these counts, none above `most` bits; 0 for what does not occur, 1 bit where it is alone.

    Source: two sorted queues, van Leeuwen 1976. Where a code is too long, counts are halved until it is not.
    """
    num = len(counts)
    weights = counts.copy()
    while True:
        order, k = _ordered(weights)
        lengths = np.zeros(num, np.int64)
        if k <= 1:
            lengths[order[0]] = k
            return lengths
        weight, parent, depth = np.zeros(2 * k, np.int64), np.zeros(2 * k, np.int64), np.zeros(2 * k, np.int64)
        for at in range(k):
            weight[at] = weights[order[at]]
        leaf, node = 0, k
        for new in range(k, 2 * k - 1):
            for _ in range(2):
                if leaf < k and (node >= new or weight[leaf] <= weight[node]):
                    smallest, leaf = leaf, leaf + 1
                else:
                    smallest, node = node, node + 1
                weight[new] += weight[smallest]
                parent[smallest] = new
        for at in range(2 * k - 3, -1, -1):
            depth[at] = depth[parent[at]] + 1
        if depth[0] <= most:  # the rarest symbol's
            for at in range(k):
                lengths[order[at]] = depth[at]
            return lengths
        for s in range(num):
            weights[s] = (weights[s] + 1) >> 1


@njit(cache=True, nogil=True)
def _ordered(weights):  # type: ignore[no-untyped-def]
    """Symbols that occur, from the rarest on, of equal ones the first before; and how many they are."""
    order, num = np.zeros(len(weights), np.int64), 0
    for s in range(len(weights)):
        if weights[s] > 0:
            at, num = num, num + 1
            while at > 0 and weights[order[at - 1]] > weights[s]:
                order[at] = order[at - 1]
                at -= 1
            order[at] = s
    return order, num


@njit(cache=True, nogil=True)
def codes_of(lengths):  # type: ignore[no-untyped-def]
    """The codes of these lengths, first bit lowest, as they are written."""
    counts, codes = np.zeros(17, np.int64), np.zeros(len(lengths), np.int64)
    for length in lengths:
        counts[length + 1] += length > 0
    next_code = np.zeros(17, np.int64)
    for bits in range(2, 17):
        next_code[bits] = (next_code[bits - 1] + counts[bits]) << 1
    for s in range(len(lengths)):
        n = lengths[s]
        if n > 0:
            word, turned = next_code[n], np.int64(0)
            next_code[n] += 1
            for _ in range(n):
                turned = turned << 1 | word & 1
                word >>= 1
            codes[s] = turned
    return codes
