#include "framing.h"

#include <string.h>

#include "crc.h"

#define HEADER_LENGTH 2u
#define CRC_LENGTH 2u
#define TOO_LONG (TORMAG_MAX_ENCODED + 1u)
#define OVERTAKEN 16u /* a frame behind the newest by less was overtaken, or repeated, or its sender has started anew */
#define ALL_MISSING ((1u << (OVERTAKEN - 1u)) - 1u)

/* COBS: each zero, and one before the start, becomes the distance to the next. `length` is under 254. */
static size_t cobs_encode(uint8_t *encoded, const uint8_t *data, size_t length)
{
    size_t mark = 0u;
    for (size_t i = 0; i < length; i++) {
        if (data[i] == 0u) {
            encoded[mark] = (uint8_t)(i + 1u - mark);
            mark = i + 1u;
        } else {
            encoded[i + 1u] = data[i];
        }
    }
    encoded[mark] = (uint8_t)(length + 1u - mark);
    return length + 1u;
}

/*
 * Inverse, for at least one byte and no zeros, into a buffer of `length` - 1. False if the distances do not end where the
 * data does.
 */
static bool cobs_decode(uint8_t *data, const uint8_t *encoded, size_t length)
{
    size_t next = encoded[0];
    for (size_t i = 1u; i < length; i++) {
        if (i == next) {
            data[i - 1u] = 0u;
            next = i + encoded[i];
        } else {
            data[i - 1u] = encoded[i];
        }
    }
    return next == length;
}

size_t tormag_frame_encode(uint8_t *bytes, uint8_t function, uint8_t sequence, const uint8_t *payload, size_t length)
{
    uint8_t body[TORMAG_FRAME_OVERHEAD + TORMAG_MAX_PAYLOAD];
    if (length > TORMAG_MAX_PAYLOAD) {
        return 0u;
    }
    body[0] = function;
    body[1] = sequence;
    if (length > 0u) { /* memcpy from a null pointer is undefined even for no bytes */
        memcpy(&body[HEADER_LENGTH], payload, length);
    }
    const uint16_t crc = tormag_crc16(body, HEADER_LENGTH + length);
    body[HEADER_LENGTH + length] = (uint8_t)(crc >> 8);
    body[HEADER_LENGTH + length + 1u] = (uint8_t)(crc & 0xFFu);
    const size_t encoded_length = cobs_encode(bytes, body, TORMAG_FRAME_OVERHEAD + length);
    bytes[encoded_length] = 0u;
    return encoded_length + 1u;
}

void tormag_frame_decoder_init(struct tormag_frame_decoder *decoder)
{
    memset(decoder, 0, sizeof *decoder);
    decoder->synchronised = true;
}

static bool parse(struct tormag_frame *frame, const uint8_t *encoded, size_t length)
{
    uint8_t body[TORMAG_FRAME_OVERHEAD + TORMAG_MAX_PAYLOAD];
    if (length > TORMAG_MAX_ENCODED || length < 1u + TORMAG_FRAME_OVERHEAD) {
        return false;
    }
    if (!cobs_decode(body, encoded, length)) {
        return false;
    }
    const size_t covered = length - 1u - CRC_LENGTH;
    if (tormag_crc16(body, covered) != (((unsigned int)body[covered] << 8) | body[covered + 1u])) {
        return false;
    }
    /* Bytes behind the payload stay zero, so that frames compare as a whole. */
    memset(frame, 0, sizeof *frame);
    frame->function = body[0];
    frame->sequence = body[1];
    frame->length = (uint8_t)(covered - HEADER_LENGTH);
    memcpy(frame->payload, &body[HEADER_LENGTH], frame->length);
    return true;
}

/* Counts what is missing before this frame; one that was counted and comes late is missing no more. */
static void count_lost(struct tormag_frame_decoder *decoder, uint8_t sequence)
{
    const uint8_t ahead = (uint8_t)(sequence - decoder->newest);
    const uint8_t behind = (uint8_t)(decoder->newest - sequence);
    if (behind < OVERTAKEN) {
        const uint16_t bit = (uint16_t)((1u << behind) >> 1);
        if ((decoder->missing & bit) != 0u) {
            decoder->missing = (uint16_t)(decoder->missing ^ bit);
            decoder->statistics.lost--;
        }
        return;
    }
    uint32_t missing = ALL_MISSING;
    if (ahead < OVERTAKEN) {
        missing = ((uint32_t)decoder->missing << ahead) | ((1u << (ahead - 1u)) - 1u);
    }
    decoder->newest = sequence;
    decoder->missing = (uint16_t)(missing & ALL_MISSING);
    decoder->statistics.lost += ahead - 1u;
}

/* Whether the caller gets the frame. */
static bool accept(struct tormag_frame_decoder *decoder, const struct tormag_frame *frame)
{
    struct tormag_framing_statistics *statistics = &decoder->statistics;
    if (!decoder->synchronised) {
        statistics->resynchronisations++;
        decoder->synchronised = true;
    }
    if (!decoder->has_last) {
        decoder->newest = frame->sequence;
    } else if (frame->sequence == decoder->last.sequence) {
        statistics->repeated++;
        if (memcmp(frame, &decoder->last, sizeof *frame) == 0) {
            return false;
        }
    }
    count_lost(decoder, frame->sequence);
    decoder->has_last = true;
    decoder->last = *frame;
    statistics->frames++;
    return true;
}

bool tormag_frame_decoder_push(struct tormag_frame_decoder *decoder, uint8_t byte, struct tormag_frame *frame)
{
    decoder->statistics.bytes++;
    if (byte != 0u) {
        if (decoder->pending_length < TORMAG_MAX_ENCODED) {
            decoder->pending[decoder->pending_length] = byte;
            decoder->pending_length++;
        } else {
            decoder->pending_length = TOO_LONG;
        }
        return false;
    }
    const size_t length = decoder->pending_length;
    decoder->pending_length = 0u;
    if (length == 0u) {
        return false;
    }
    if (!parse(frame, decoder->pending, length)) {
        decoder->statistics.corrupt++;
        decoder->synchronised = false;
        return false;
    }
    return accept(decoder, frame);
}
