#include "fuzz.h"

#include <string.h>

#include "../framing.h"

/* A decoder, the bytes since the last delimiter, and what it gave. */
struct listener {
    struct tormag_frame_decoder decoder;
    uint8_t stretch[TORMAG_MAX_FRAME];
    size_t stretch_length;
    bool has_last;
    struct tormag_frame last;
    uint32_t bytes, delimiters, given;
};

/* Whether the byte completed a frame, which is then `last`: its bytes came as they would be sent, and it is no repetition. */
static bool hear(struct listener *listener, uint8_t byte)
{
    struct tormag_frame frame;
    const bool is_given = tormag_frame_decoder_push(&listener->decoder, byte, &frame);
    listener->bytes++;
    if (listener->stretch_length < sizeof listener->stretch) {
        listener->stretch[listener->stretch_length++] = byte;
    }
    if (is_given) {
        uint8_t again[TORMAG_MAX_FRAME];
        REQUIRE(byte == 0u);
        REQUIRE(frame.length <= TORMAG_MAX_PAYLOAD);
        const size_t length = tormag_frame_encode(again, frame.function, frame.sequence, frame.payload, frame.length);
        REQUIRE(length == listener->stretch_length && memcmp(again, listener->stretch, length) == 0);
        REQUIRE(!listener->has_last || memcmp(&frame, &listener->last, sizeof frame) != 0);
        listener->has_last = true;
        listener->last = frame;
        listener->given++;
    }
    if (byte == 0u) {
        listener->delimiters++;
        listener->stretch_length = 0u;
    }
    return is_given;
}

/* A whole frame. Behind a delimiter it is given, unless it repeats the one before it. */
static bool hear_frame(
    struct listener *listener, uint8_t function, uint8_t sequence, const uint8_t *payload, size_t length)
{
    uint8_t bytes[TORMAG_MAX_FRAME];
    const size_t frame_length = tormag_frame_encode(bytes, function, sequence, payload, length);
    REQUIRE((frame_length == 0u) == (length > TORMAG_MAX_PAYLOAD));
    const struct tormag_frame before = listener->last;
    const bool had_last = listener->has_last;
    const bool is_clean = listener->stretch_length == 0u && frame_length > 0u;
    bool is_given = false;
    for (size_t i = 0; i < frame_length; i++) {
        is_given = hear(listener, bytes[i]);
    }
    if (is_clean && !is_given) {
        REQUIRE(had_last && before.function == function && before.sequence == sequence && before.length == length);
        REQUIRE(length == 0u || memcmp(before.payload, payload, length) == 0);
    }
    return is_given;
}

void tormag_fuzz_framing(const uint8_t *data, size_t size)
{
    static const uint8_t ANCHOR[] = {1, 0, 2};
    struct listener listener;
    memset(&listener, 0, sizeof listener);
    tormag_frame_decoder_init(&listener.decoder);
    size_t at = 0u;
    while (at < size) {
        const uint8_t piece = data[at++];
        const bool is_frame = piece >= 128u && size - at >= 2u;
        const size_t header = is_frame ? 2u : 0u;
        size_t length = is_frame ? piece & 15u : piece;
        if (length > size - at - header) {
            length = size - at - header;
        }
        if (is_frame) {
            (void)hear_frame(&listener, data[at], data[at + 1u], data + at + 2u, length);
        } else {
            for (size_t i = 0; i < length; i++) {
                (void)hear(&listener, data[at + i]);
            }
        }
        at += header + length;
    }
    /* of two clean frames after anything the second arrives */
    const uint8_t sequence = listener.last.sequence;
    (void)hear_frame(&listener, 1u, (uint8_t)(sequence + 1u), ANCHOR, sizeof ANCHOR);
    REQUIRE(hear_frame(&listener, 1u, (uint8_t)(sequence + 2u), ANCHOR, sizeof ANCHOR));
    const struct tormag_framing_statistics *counted = &listener.decoder.statistics;
    REQUIRE(counted->bytes == listener.bytes && counted->frames == listener.given);
    REQUIRE(counted->frames + counted->corrupt <= listener.delimiters);
    REQUIRE(counted->resynchronisations <= counted->corrupt);
    REQUIRE(counted->lost <= 255u * counted->frames);
}
