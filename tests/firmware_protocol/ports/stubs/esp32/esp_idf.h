/* The part of ESP-IDF 5 that the skeleton uses: declarations alone. */
#ifndef STUB_ESP_IDF_H
#define STUB_ESP_IDF_H
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
typedef int esp_err_t;
#define ESP_OK 0
typedef int gpio_num_t;
typedef enum { GPIO_MODE_INPUT = 1, GPIO_MODE_OUTPUT = 2 } gpio_mode_t;
esp_err_t gpio_set_level(gpio_num_t pin, uint32_t level);
esp_err_t gpio_set_direction(gpio_num_t pin, gpio_mode_t mode);
typedef enum { GPIO_PULLUP_ONLY = 0 } gpio_pull_mode_t;
esp_err_t gpio_set_pull_mode(gpio_num_t pin, gpio_pull_mode_t pull);
int gpio_get_level(gpio_num_t pin);
typedef enum { LEDC_LOW_SPEED_MODE = 0 } ledc_mode_t;
typedef enum { LEDC_CHANNEL_0 = 0, LEDC_CHANNEL_1 } ledc_channel_t;
typedef enum { LEDC_TIMER_0 = 0 } ledc_timer_t;
typedef enum { LEDC_TIMER_10_BIT = 10 } ledc_timer_bit_t;
typedef enum { LEDC_AUTO_CLK = 0 } ledc_clk_cfg_t;
typedef struct { ledc_mode_t speed_mode; ledc_timer_bit_t duty_resolution; ledc_timer_t timer_num; uint32_t freq_hz; ledc_clk_cfg_t clk_cfg; } ledc_timer_config_t;
typedef struct { int gpio_num; ledc_mode_t speed_mode; ledc_channel_t channel; ledc_timer_t timer_sel; uint32_t duty; int hpoint; } ledc_channel_config_t;
esp_err_t ledc_timer_config(const ledc_timer_config_t *timer);
esp_err_t ledc_channel_config(const ledc_channel_config_t *channel);
esp_err_t ledc_set_duty(ledc_mode_t mode, ledc_channel_t channel, uint32_t duty);
esp_err_t ledc_update_duty(ledc_mode_t mode, ledc_channel_t channel);
typedef struct pcnt_unit_t *pcnt_unit_handle_t;
esp_err_t pcnt_unit_get_count(pcnt_unit_handle_t unit, int *value);
typedef enum { TWAI_MODE_NORMAL = 0 } twai_mode_t;
typedef enum { TWAI_STATE_STOPPED = 0, TWAI_STATE_RUNNING, TWAI_STATE_BUS_OFF, TWAI_STATE_RECOVERING } twai_state_t;
typedef struct { twai_mode_t mode; gpio_num_t tx_io, rx_io; } twai_general_config_t;
typedef struct { uint32_t brp; } twai_timing_config_t;
typedef struct { uint32_t acceptance_code, acceptance_mask; } twai_filter_config_t;
typedef struct { uint32_t extd : 1; uint32_t rtr : 1; uint32_t identifier; uint8_t data_length_code; uint8_t data[8]; } twai_message_t;
typedef struct { twai_state_t state; uint32_t tx_error_counter, rx_error_counter; } twai_status_info_t;
#define TWAI_GENERAL_CONFIG_DEFAULT(tx, rx, m) {.mode = (m), .tx_io = (tx), .rx_io = (rx)}
#define TWAI_TIMING_CONFIG_500KBITS() {.brp = 8}
#define TWAI_FILTER_CONFIG_ACCEPT_ALL() {.acceptance_mask = 0xFFFFFFFF}
esp_err_t twai_driver_install(const twai_general_config_t *g, const twai_timing_config_t *t, const twai_filter_config_t *f);
esp_err_t twai_start(void);
esp_err_t twai_initiate_recovery(void);
esp_err_t twai_receive(twai_message_t *message, uint32_t ticks);
esp_err_t twai_transmit(const twai_message_t *message, uint32_t ticks);
esp_err_t twai_get_status_info(twai_status_info_t *info);
uint32_t esp_random(void);
int64_t esp_timer_get_time(void);
typedef enum { ESP_RST_UNKNOWN, ESP_RST_POWERON, ESP_RST_EXT, ESP_RST_SW, ESP_RST_PANIC, ESP_RST_INT_WDT, ESP_RST_TASK_WDT,
               ESP_RST_WDT, ESP_RST_DEEPSLEEP, ESP_RST_BROWNOUT } esp_reset_reason_t;
esp_reset_reason_t esp_reset_reason(void);
typedef struct { uint32_t timeout_ms; uint32_t idle_core_mask; bool trigger_panic; } esp_task_wdt_config_t;
typedef void *TaskHandle_t;
esp_err_t esp_task_wdt_reconfigure(const esp_task_wdt_config_t *config);
esp_err_t esp_task_wdt_add(TaskHandle_t task);
esp_err_t esp_task_wdt_reset(void);
#define configMAX_PRIORITIES 25
int xTaskCreatePinnedToCore(void (*task)(void *), const char *name, uint32_t stack, void *with, unsigned priority, TaskHandle_t *out, int core);
void vTaskDelay(uint32_t ticks);
typedef uint32_t nvs_handle_t;
typedef enum { NVS_READONLY, NVS_READWRITE } nvs_open_mode_t;
esp_err_t nvs_flash_init(void);
esp_err_t nvs_open(const char *name, nvs_open_mode_t mode, nvs_handle_t *handle);
esp_err_t nvs_get_blob(nvs_handle_t handle, const char *key, void *value, size_t *length);
esp_err_t nvs_set_blob(nvs_handle_t handle, const char *key, const void *value, size_t length);
esp_err_t nvs_commit(nvs_handle_t handle);
void nvs_close(nvs_handle_t handle);
#endif
