/*
 * What the fuzzer asks of the sources, beside the sanitizers: each function takes any bytes and ends the program where
 * something does not hold. For libFuzzer on a computer, no part of a firmware.
 */
#ifndef TORMAG_FUZZ_H
#define TORMAG_FUZZ_H

#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>

#define REQUIRE(condition) \
    do { \
        if (!(condition)) { \
            fprintf(stderr, "does not hold: %s, %s:%d\n", #condition, __FILE__, __LINE__); \
            abort(); \
        } \
    } while (0)

/* FUNCTION and a payload: decoded only where length and CRC-8 are right, and encoded again to the same bytes. */
void tormag_fuzz_codec(const uint8_t *data, size_t size);

/*
 * Pieces of a stream. N under 128: the next N bytes as they are. Else a frame with the right CRC-16: FUNCTION, SEQUENCE
 * and the low four bits' number of payload bytes. What the decoder gives is the stream's own bytes, once, in time.
 */
void tormag_fuzz_framing(const uint8_t *data, size_t size);

/* A device's life, one step after the other, as device.c tells: its mode, faults and outputs keep their rules. */
void tormag_fuzz_device(const uint8_t *data, size_t size);

#endif
