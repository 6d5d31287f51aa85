/* Generated from tormag.dbc; to change it, see firmware_protocol/generate.py. */
#ifndef TORMAG_MESSAGES_H
#define TORMAG_MESSAGES_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "tormag.h"

#define TORMAG_PROTOCOL_VERSION 1u
#define TORMAG_SCHEMA_HASH 0x4B3A3191u
#define TORMAG_MAX_PAYLOAD 8u

/* A message's function: the serial frame's type, and the upper part of the CAN identifier. */
#define TORMAG_FUNCTION_RETRACT 1u
#define TORMAG_FUNCTION_DRIVE 2u
#define TORMAG_FUNCTION_STATE 3u
#define TORMAG_FUNCTION_SENSE 4u
#define TORMAG_FUNCTION_CLEAR 5u
#define TORMAG_FUNCTION_HOME 6u
#define TORMAG_FUNCTION_STATUS 7u
#define TORMAG_FUNCTION_HELLO 8u
#define TORMAG_FUNCTION_IDENTITY 9u

#define TORMAG_CAN_IDENTIFIER(function, node) (((function) << 4) | (node))

/* Physical value = step * scale; all other signals are bare numbers. */
#define TORMAG_DRIVE_LEFT_DUTY_SCALE 0.0001
#define TORMAG_DRIVE_RIGHT_DUTY_SCALE 0.0001
#define TORMAG_STATE_LEFT_POSITION_MM_SCALE 0.0017857142857142857 /* mm */
#define TORMAG_STATE_RIGHT_POSITION_MM_SCALE 0.0017857142857142857 /* mm */
#define TORMAG_STATE_DEVICE_TIME_S_SCALE 1e-05 /* s */
#define TORMAG_SENSE_LEFT_CURRENT_A_SCALE 0.001 /* A */
#define TORMAG_SENSE_RIGHT_CURRENT_A_SCALE 0.001 /* A */
#define TORMAG_SENSE_FORCE_N_SCALE 0.001 /* N */
#define TORMAG_SENSE_HANDLE_POSITION_MM_SCALE 0.007669903939428206 /* mm */
#define TORMAG_STATUS_TEMPERATURE_C_SCALE 1.0 /* degC */
#define TORMAG_STATUS_SUPPLY_V_SCALE 0.1 /* V */

/* One message, its signals as the steps on the wire. */
struct tormag_message {
    uint8_t function;
    union {
        struct tormag_retract_t retract;
        struct tormag_drive_t drive;
        struct tormag_state_t state;
        struct tormag_sense_t sense;
        struct tormag_clear_t clear;
        struct tormag_home_t home;
        struct tormag_status_t status;
        struct tormag_hello_t hello;
        struct tormag_identity_t identity;
    } signals;
};

/* Bytes in the payload of a function's message; 0 for a function that is none. */
size_t tormag_message_length(uint8_t function);

/* Whether the last byte of the payload is a CRC-8. */
bool tormag_message_protected(uint8_t function);

/* Whether every signal's step is in its range; false for an unknown function. */
bool tormag_message_in_range(const struct tormag_message *message);

/* Steps of a known function's message to its payload, tormag_message_length() bytes; no range is checked. */
void tormag_message_pack(uint8_t *payload, const struct tormag_message *message);

/* Payload, tormag_message_length() bytes, to the steps of message->function; no range is checked. */
void tormag_message_unpack(struct tormag_message *message, const uint8_t *payload);

#endif
