/* ESP32 with ESP-IDF 5 on a CAN bus (TWAI), which needs a transceiver: compile this and controller.c with
 * -DDISCO_LINK_CAN, and call its main as a task pinned to a core, as app_main does here. Compiled against stub headers in
 * the tests; NOT RUN ON HARDWARE. */
#include "port.h"

#include <string.h>

#include "driver/gpio.h"
#include "driver/ledc.h"
#include "driver/pulse_cnt.h"
#include "driver/twai.h"
#include "esp_random.h"
#include "esp_system.h"
#include "esp_task_wdt.h"
#include "esp_timer.h"
#include "freertos/FreeRTOS.h"
#include "freertos/task.h"
#include "nvs.h"
#include "nvs_flash.h"

#define TICKS_PER_REV (2048u)
#define MAX_WHEEL_SPEED (8.0f)
#define TWO_PI (6.2831853f)
#define SPEED_FILTER_S (0.01f)
#define PWM_FULL (1023.0f)
#define WATCHDOG_MS (50u)
#define STANDARD_DATA (8u)

enum { PIN_LEFT_PWM = 18, PIN_RIGHT_PWM = 19, PIN_TX = 21, PIN_RX = 22, PIN_ENABLE = 25, PIN_BRAKE = 26, PIN_ESTOP = 27,
       PIN_LEFT_DIR = 32, PIN_RIGHT_DIR = 33 };

int main(void); /* controller.c */
void app_main(void);
pcnt_unit_handle_t encoder_start(int side); /* pulse_cnt with accumulation, as in ESP-IDF's rotary_encoder example */

static pcnt_unit_handle_t encoders[2];
static int last_count[2];

static void controller(void *unused)
{
    (void)unused;
    (void)main();
}

void app_main(void)
{
    (void)xTaskCreatePinnedToCore(controller, "disco", 4096, NULL, configMAX_PRIORITIES - 1, NULL, 1);
}

disco_reset_cause_t port_start(disco_config_t *config)
{
    static const esp_task_wdt_config_t watchdog = {.timeout_ms = WATCHDOG_MS, .idle_core_mask = 0, .trigger_panic = true};
    static const ledc_timer_config_t pwm = {.speed_mode = LEDC_LOW_SPEED_MODE, .duty_resolution = LEDC_TIMER_10_BIT,
                                            .timer_num = LEDC_TIMER_0, .freq_hz = 20000, .clk_cfg = LEDC_AUTO_CLK};
    static const ledc_channel_config_t motors[2] = {
        {.gpio_num = PIN_LEFT_PWM, .speed_mode = LEDC_LOW_SPEED_MODE, .channel = LEDC_CHANNEL_0, .timer_sel = LEDC_TIMER_0},
        {.gpio_num = PIN_RIGHT_PWM, .speed_mode = LEDC_LOW_SPEED_MODE, .channel = LEDC_CHANNEL_1, .timer_sel = LEDC_TIMER_0},
    };
    const twai_general_config_t general = TWAI_GENERAL_CONFIG_DEFAULT(PIN_TX, PIN_RX, TWAI_MODE_NORMAL);
    const twai_timing_config_t timing = TWAI_TIMING_CONFIG_500KBITS();
    const twai_filter_config_t filter = TWAI_FILTER_CONFIG_ACCEPT_ALL();
    (void)gpio_set_level(PIN_ENABLE, 0);
    (void)gpio_set_level(PIN_BRAKE, 1);
    (void)gpio_set_direction(PIN_ENABLE, GPIO_MODE_OUTPUT);
    (void)gpio_set_direction(PIN_BRAKE, GPIO_MODE_OUTPUT);
    (void)gpio_set_direction(PIN_LEFT_DIR, GPIO_MODE_OUTPUT);
    (void)gpio_set_direction(PIN_RIGHT_DIR, GPIO_MODE_OUTPUT);
    (void)gpio_set_direction(PIN_ESTOP, GPIO_MODE_INPUT);
    (void)gpio_set_pull_mode(PIN_ESTOP, GPIO_PULLUP_ONLY); /* pins 34 to 39 have none */
    (void)ledc_timer_config(&pwm);
    (void)ledc_channel_config(&motors[0]);
    (void)ledc_channel_config(&motors[1]);
    encoders[0] = encoder_start(0);
    encoders[1] = encoder_start(1);
    (void)nvs_flash_init();
    (void)twai_driver_install(&general, &timing, &filter);
    (void)twai_start();
    (void)esp_task_wdt_reconfigure(&watchdog);
    (void)esp_task_wdt_add(NULL);
    config->ticks_per_rev = TICKS_PER_REV;
    config->max_wheel_speed = MAX_WHEEL_SPEED;
    config->board_id = 0x0032u;
    switch (esp_reset_reason()) {
    case ESP_RST_TASK_WDT:
    case ESP_RST_INT_WDT:
    case ESP_RST_WDT:
    case ESP_RST_PANIC:
        return DISCO_RESET_WATCHDOG;
    case ESP_RST_BROWNOUT:
        return DISCO_RESET_BROWN_OUT;
    default:
        return DISCO_RESET_POWER_ON;
    }
}

uint32_t port_now_us(void)
{
    return (uint32_t)esp_timer_get_time();
}

/* The TWAI driver has queues of its own between its interrupt and this task. */
bool port_receive(disco_frame_t *frame)
{
    twai_message_t message;
    while (twai_receive(&message, 0) == ESP_OK) {
        if (!message.extd && !message.rtr) {
            frame->can_id = (uint16_t)message.identifier;
            frame->length = (message.data_length_code < STANDARD_DATA) ? message.data_length_code : STANDARD_DATA;
            (void)memcpy(frame->data, message.data, frame->length);
            return true;
        }
    }
    return false;
}

bool port_send(const disco_frame_t *frame)
{
    twai_message_t message = {.identifier = frame->can_id, .data_length_code = frame->length};
    (void)memcpy(message.data, frame->data, frame->length);
    return twai_transmit(&message, 0) == ESP_OK;
}

uint64_t port_entropy(uint64_t *last)
{
    /* True randomness needs the radio or bootloader_random_enable; without, the count of starts makes it another one. */
    uint64_t kept[2] = {0u, 0u}; /* starts, the last one's entropy */
    size_t length = sizeof(kept);
    nvs_handle_t store;
    if (nvs_open("disco", NVS_READWRITE, &store) != ESP_OK) {
        return 0u;
    }
    (void)nvs_get_blob(store, "starts", kept, &length);
    *last = kept[1];
    kept[0]++;
    kept[1] = (((uint64_t)esp_random() << 32) | esp_random()) + kept[0];
    const bool counted = (nvs_set_blob(store, "starts", kept, sizeof(kept)) == ESP_OK) && (nvs_commit(store) == ESP_OK);
    nvs_close(store);
    return counted ? kept[1] : 0u;
}

void port_measure(port_measurement_t *measurement)
{
    static uint32_t measured_us;
    disco_inputs_t *inputs = &measurement->inputs;
    /* Cycles that were late come one after the other: the time that passed is not always the cycle's. */
    const uint32_t now_us = port_now_us();
    const float passed_s = (float)(now_us - measured_us) * 1.0e-6f;
    measured_us = now_us;
    twai_status_info_t bus;
    for (uint8_t side = 0u; side < 2u; side++) {
        int count = last_count[side];
        inputs->encoder_valid[side] = pcnt_unit_get_count(encoders[side], &count) == ESP_OK;
        const float angle = (float)(count - last_count[side]) * (TWO_PI / (float)TICKS_PER_REV);
        last_count[side] = count;
        inputs->ticks[side] = (uint32_t)count;
        inputs->wheel_speed[side] += (angle - (inputs->wheel_speed[side] * passed_s)) / SPEED_FILTER_S;
        inputs->temperature[side] = 25.0f;
    }
    if (twai_get_status_info(&bus) == ESP_OK) {
        inputs->tx_error_count = (uint16_t)((bus.state == TWAI_STATE_BUS_OFF) ? 256u : bus.tx_error_counter);
        inputs->rx_error_count = (uint16_t)bus.rx_error_counter;
        if (bus.state == TWAI_STATE_BUS_OFF) {
            (void)twai_initiate_recovery();
        } else if (bus.state == TWAI_STATE_STOPPED) {
            (void)twai_start();
        }
    }
    inputs->estop_button = gpio_get_level(PIN_ESTOP) != 0; /* a broken wire stops: the button opens, the pull-up lifts */
}

static void drive_wheel(ledc_channel_t channel, int direction, float setpoint)
{
    const float part = setpoint * (PWM_FULL / MAX_WHEEL_SPEED);
    (void)gpio_set_level(direction, part < 0.0f);
    (void)ledc_set_duty(LEDC_LOW_SPEED_MODE, channel, (uint32_t)(part < 0.0f ? -part : part));
    (void)ledc_update_duty(LEDC_LOW_SPEED_MODE, channel);
}

void port_drive(const disco_outputs_t *outputs)
{
    /* Feed-forward alone: a speed loop of your own goes here. */
    drive_wheel(LEDC_CHANNEL_0, PIN_LEFT_DIR, outputs->left_setpoint);
    drive_wheel(LEDC_CHANNEL_1, PIN_RIGHT_DIR, outputs->right_setpoint);
    (void)gpio_set_level(PIN_ENABLE, outputs->driver_enabled);
    (void)gpio_set_level(PIN_BRAKE, outputs->brake);
}

void port_feed_watchdog(void)
{
    (void)esp_task_wdt_reset();
}

bool port_load(uint8_t *record)
{
    size_t length = DISCO_RECORD_LENGTH;
    nvs_handle_t store;
    if (nvs_open("disco", NVS_READONLY, &store) != ESP_OK) {
        return false;
    }
    const bool found = nvs_get_blob(store, "record", record, &length) == ESP_OK;
    nvs_close(store);
    return found && (length == (size_t)DISCO_RECORD_LENGTH);
}

/* May take longer than the watchdog allows when a page is erased: its reset is told as such. */
void port_store(const uint8_t *record)
{
    nvs_handle_t store;
    if (nvs_open("disco", NVS_READWRITE, &store) == ESP_OK) {
        (void)nvs_set_blob(store, "record", record, DISCO_RECORD_LENGTH);
        (void)nvs_commit(store);
        nvs_close(store);
    }
}

void port_wait(void)
{
    vTaskDelay(1); /* CONFIG_FREERTOS_HZ=1000 */
}
