/* Generated from tormag.dbc; to change it, see firmware_protocol/generate.py. */
#include "messages.h"

size_t tormag_message_length(uint8_t function)
{
    switch (function) {
    case TORMAG_FUNCTION_RETRACT:
        return TORMAG_RETRACT_LENGTH;
    case TORMAG_FUNCTION_DRIVE:
        return TORMAG_DRIVE_LENGTH;
    case TORMAG_FUNCTION_STATE:
        return TORMAG_STATE_LENGTH;
    case TORMAG_FUNCTION_SENSE:
        return TORMAG_SENSE_LENGTH;
    case TORMAG_FUNCTION_CLEAR:
        return TORMAG_CLEAR_LENGTH;
    case TORMAG_FUNCTION_HOME:
        return TORMAG_HOME_LENGTH;
    case TORMAG_FUNCTION_STATUS:
        return TORMAG_STATUS_LENGTH;
    case TORMAG_FUNCTION_HELLO:
        return TORMAG_HELLO_LENGTH;
    case TORMAG_FUNCTION_IDENTITY:
        return TORMAG_IDENTITY_LENGTH;
    default:
        return 0u;
    }
}

bool tormag_message_protected(uint8_t function)
{
    return function == TORMAG_FUNCTION_DRIVE || function == TORMAG_FUNCTION_STATE;
}

bool tormag_message_in_range(const struct tormag_message *message)
{
    switch (message->function) {
    case TORMAG_FUNCTION_RETRACT:
        return tormag_retract_nonce_is_in_range(message->signals.retract.nonce);
    case TORMAG_FUNCTION_DRIVE:
        return tormag_drive_left_duty_is_in_range(message->signals.drive.left_duty)
            && tormag_drive_right_duty_is_in_range(message->signals.drive.right_duty)
            && tormag_drive_mode_is_in_range(message->signals.drive.mode)
            && tormag_drive_counter_is_in_range(message->signals.drive.counter);
    case TORMAG_FUNCTION_STATE:
        return tormag_state_left_position_mm_is_in_range(message->signals.state.left_position_mm)
            && tormag_state_right_position_mm_is_in_range(message->signals.state.right_position_mm)
            && tormag_state_device_time_s_is_in_range(message->signals.state.device_time_s)
            && tormag_state_counter_is_in_range(message->signals.state.counter);
    case TORMAG_FUNCTION_SENSE:
        return tormag_sense_left_current_a_is_in_range(message->signals.sense.left_current_a)
            && tormag_sense_right_current_a_is_in_range(message->signals.sense.right_current_a)
            && tormag_sense_force_n_is_in_range(message->signals.sense.force_n)
            && tormag_sense_handle_position_mm_is_in_range(message->signals.sense.handle_position_mm);
    case TORMAG_FUNCTION_CLEAR:
        return tormag_clear_nonce_is_in_range(message->signals.clear.nonce);
    case TORMAG_FUNCTION_HOME:
        return tormag_home_nonce_is_in_range(message->signals.home.nonce);
    case TORMAG_FUNCTION_STATUS:
        return tormag_status_mode_is_in_range(message->signals.status.mode)
            && tormag_status_switches_is_in_range(message->signals.status.switches)
            && tormag_status_faults_is_in_range(message->signals.status.faults)
            && tormag_status_temperature_c_is_in_range(message->signals.status.temperature_c)
            && tormag_status_supply_v_is_in_range(message->signals.status.supply_v)
            && tormag_status_drive_counter_is_in_range(message->signals.status.drive_counter)
            && tormag_status_command_nonce_is_in_range(message->signals.status.command_nonce);
    case TORMAG_FUNCTION_HELLO:
        return tormag_hello_schema_hash_is_in_range(message->signals.hello.schema_hash)
            && tormag_hello_protocol_version_is_in_range(message->signals.hello.protocol_version)
            && tormag_hello_nonce_is_in_range(message->signals.hello.nonce);
    case TORMAG_FUNCTION_IDENTITY:
        return tormag_identity_schema_hash_is_in_range(message->signals.identity.schema_hash)
            && tormag_identity_firmware_major_is_in_range(message->signals.identity.firmware_major)
            && tormag_identity_firmware_minor_is_in_range(message->signals.identity.firmware_minor)
            && tormag_identity_serial_number_is_in_range(message->signals.identity.serial_number);
    default:
        return false;
    }
}

void tormag_message_pack(uint8_t *payload, const struct tormag_message *message)
{
    switch (message->function) {
    case TORMAG_FUNCTION_RETRACT:
        (void)tormag_retract_pack(payload, &message->signals.retract, TORMAG_RETRACT_LENGTH);
        break;
    case TORMAG_FUNCTION_DRIVE:
        (void)tormag_drive_pack(payload, &message->signals.drive, TORMAG_DRIVE_LENGTH);
        break;
    case TORMAG_FUNCTION_STATE:
        (void)tormag_state_pack(payload, &message->signals.state, TORMAG_STATE_LENGTH);
        break;
    case TORMAG_FUNCTION_SENSE:
        (void)tormag_sense_pack(payload, &message->signals.sense, TORMAG_SENSE_LENGTH);
        break;
    case TORMAG_FUNCTION_CLEAR:
        (void)tormag_clear_pack(payload, &message->signals.clear, TORMAG_CLEAR_LENGTH);
        break;
    case TORMAG_FUNCTION_HOME:
        (void)tormag_home_pack(payload, &message->signals.home, TORMAG_HOME_LENGTH);
        break;
    case TORMAG_FUNCTION_STATUS:
        (void)tormag_status_pack(payload, &message->signals.status, TORMAG_STATUS_LENGTH);
        break;
    case TORMAG_FUNCTION_HELLO:
        (void)tormag_hello_pack(payload, &message->signals.hello, TORMAG_HELLO_LENGTH);
        break;
    case TORMAG_FUNCTION_IDENTITY:
        (void)tormag_identity_pack(payload, &message->signals.identity, TORMAG_IDENTITY_LENGTH);
        break;
    default:
        break;
    }
}

void tormag_message_unpack(struct tormag_message *message, const uint8_t *payload)
{
    switch (message->function) {
    case TORMAG_FUNCTION_RETRACT:
        (void)tormag_retract_unpack(&message->signals.retract, payload, TORMAG_RETRACT_LENGTH);
        break;
    case TORMAG_FUNCTION_DRIVE:
        (void)tormag_drive_unpack(&message->signals.drive, payload, TORMAG_DRIVE_LENGTH);
        break;
    case TORMAG_FUNCTION_STATE:
        (void)tormag_state_unpack(&message->signals.state, payload, TORMAG_STATE_LENGTH);
        break;
    case TORMAG_FUNCTION_SENSE:
        (void)tormag_sense_unpack(&message->signals.sense, payload, TORMAG_SENSE_LENGTH);
        break;
    case TORMAG_FUNCTION_CLEAR:
        (void)tormag_clear_unpack(&message->signals.clear, payload, TORMAG_CLEAR_LENGTH);
        break;
    case TORMAG_FUNCTION_HOME:
        (void)tormag_home_unpack(&message->signals.home, payload, TORMAG_HOME_LENGTH);
        break;
    case TORMAG_FUNCTION_STATUS:
        (void)tormag_status_unpack(&message->signals.status, payload, TORMAG_STATUS_LENGTH);
        break;
    case TORMAG_FUNCTION_HELLO:
        (void)tormag_hello_unpack(&message->signals.hello, payload, TORMAG_HELLO_LENGTH);
        break;
    case TORMAG_FUNCTION_IDENTITY:
        (void)tormag_identity_unpack(&message->signals.identity, payload, TORMAG_IDENTITY_LENGTH);
        break;
    default:
        break;
    }
}
