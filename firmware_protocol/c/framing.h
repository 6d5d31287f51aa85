/*
 * Payloads on a serial line:
 *
 *     COBS( function | sequence | payload | CRC-16/GENIBUS, big-endian ) 00
 *
 * No heap and no recursion; every loop is bounded by TORMAG_MAX_FRAME.
 */
#ifndef TORMAG_FRAMING_H
#define TORMAG_FRAMING_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "messages.h"

#define TORMAG_FRAME_OVERHEAD 4u /* function, sequence, CRC-16 */
#define TORMAG_MAX_ENCODED (1u + TORMAG_FRAME_OVERHEAD + TORMAG_MAX_PAYLOAD) /* COBS adds one byte */
#define TORMAG_MAX_FRAME (TORMAG_MAX_ENCODED + 1u)                           /* with its delimiter */

struct tormag_frame {
    uint8_t function;
    uint8_t sequence;
    uint8_t length;
    uint8_t payload[TORMAG_MAX_PAYLOAD];
};

/* What a decoder has seen since it was initialised; all run over modulo 2^32. */
struct tormag_framing_statistics {
    uint32_t bytes;
    uint32_t frames;            /* given to the caller */
    uint32_t corrupt;           /* stretches between two delimiters that were not a frame */
    uint32_t lost;              /* missing from the sequence, and not only overtaken on their way */
    uint32_t repeated;          /* with the sequence number of the frame before */
    uint32_t resynchronisations; /* frames found again after something corrupt */
};

struct tormag_frame_decoder {
    struct tormag_framing_statistics statistics;
    uint8_t pending[TORMAG_MAX_ENCODED];
    uint8_t pending_length; /* TORMAG_MAX_ENCODED + 1 once it is too long to be a frame */
    bool synchronised;
    bool has_last;
    struct tormag_frame last;
    uint8_t newest;   /* sequence number that is furthest on */
    uint16_t missing; /* of those before it, a bit each, the nearest lowest */
};

/*
 * Writes one frame with its delimiter to `bytes`, which takes TORMAG_MAX_FRAME, and returns its length; 0 for a payload
 * over TORMAG_MAX_PAYLOAD, which is not to be sent.
 */
size_t tormag_frame_encode(uint8_t *bytes, uint8_t function, uint8_t sequence, const uint8_t *payload, size_t length);

void tormag_frame_decoder_init(struct tormag_frame_decoder *decoder);

/*
 * Takes one byte of the stream, as from a receive interrupt or a DMA buffer. True if it completed a frame, which is
 * then in `frame`. A frame that repeats the one before it byte for byte is counted and not given; one that repeats only
 * the sequence number comes from a sender that started anew, and is.
 */
bool tormag_frame_decoder_push(struct tormag_frame_decoder *decoder, uint8_t byte, struct tormag_frame *frame);

#endif
