#include "rejection.h"

#include "protocol_constants.h"

void disco_reject(disco_firmware_t *core, uint8_t reason)
{
    core->reject_reason = reason;
    core->rejected[reason]++;
    core->rejected_total++;
}

bool disco_e2e_usable(disco_firmware_t *core, disco_e2e_status_t status, bool qualified)
{
    bool usable = false;
    switch (status) {
    case DISCO_E2E_OK:
    case DISCO_E2E_OK_SOME_LOST:
        if (status == DISCO_E2E_OK_SOME_LOST) {
            core->sequence_errors++;
        }
        usable = qualified;
        if (!usable) {
            disco_reject(core, DISCO_REJECT_REASON_NOT_QUALIFIED);
        }
        break;
    case DISCO_E2E_REPEATED:
        core->sequence_errors++;
        disco_reject(core, DISCO_REJECT_REASON_REPEATED);
        break;
    case DISCO_E2E_WRONG_SEQUENCE:
        core->sequence_errors++;
        disco_reject(core, DISCO_REJECT_REASON_SEQUENCE);
        break;
    case DISCO_E2E_WRONG_CRC:
        break; /* counted where the CRC was computed */
    case DISCO_E2E_INITIAL:
    default:
        disco_reject(core, DISCO_REJECT_REASON_NOT_QUALIFIED);
        break;
    }
    return usable;
}
