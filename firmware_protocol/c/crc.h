/* The two checksums of the wire, bit by bit: frames are short, and a microcontroller has better uses for its flash. */
#ifndef TORMAG_CRC_H
#define TORMAG_CRC_H

#include <stddef.h>
#include <stdint.h>

/* CRC-8/SAE-J1850 over a message's function byte and `length` bytes of its payload. */
uint8_t tormag_crc8(uint8_t function, const uint8_t *payload, size_t length);

/* CRC-16/GENIBUS over `length` bytes. */
uint16_t tormag_crc16(const uint8_t *data, size_t length);

#endif
