"""What the skeletons ask of their vendors' libraries, whose functions do nothing here but print their name."""

import re
import subprocess

import pytest

from tests.firmware_protocol.ports.test_ports import LINKS, PORTS, STUBS, compiled

HEADERS = {"stm32": "main.h", "rp2040": "pico/stdlib.h", "esp32": "esp_idf.h"}


def do_nothing(declaration):
    """Define a declared function: it prints its name and its numbers, and returns 0."""
    result, name, parameters = re.fullmatch(r"([\w ]+?[ *])(\w+)\((.*)\);", declaration).groups()
    numbers = [each.split()[-1] for each in parameters.split(", ") if each != "void" and not set("*(") & set(each)]
    values = "".join(f", (long){number}" for number in numbers)
    ends = "" if result.strip() == "void" else " return 0;"
    return f'{result}{name}({parameters}) {{ printf("{name}{" %ld" * len(numbers)}\\n"{values});{ends} }}\n'


@pytest.fixture
def calls(tmp_path):
    """Run `main` with a skeleton; return its lines: the vendor's functions called, and what `main` itself prints."""

    def run(port, main, definitions=""):
        header = (STUBS / port / HEADERS[port]).read_text("utf-8")
        declarations = re.findall(r"^((?!typedef|extern)[\w ]+[ *](\w+)\(.*\);)$", header, re.MULTILINE)
        stubs = [do_nothing(declaration) for declaration, name in declarations if f" {name}(" not in definitions]
        source, program = tmp_path / "main.c", tmp_path / "board"
        source.write_text(
            f'#include <stdio.h>\n#include "port.h"\n#include "{HEADERS[port]}"\n'
            f"{''.join(stubs)}{definitions}\n"
            f"int main(void)\n{{\n    disco_config_t config;\n{main}\n    return 0;\n}}\n"
        )
        options = [f"-I{STUBS / port}", f"-I{PORTS / port}", "-Wno-unused-parameter", *LINKS.get(port, [])]
        compiled(PORTS / port / "port.c", source, "-o", program, options=options)
        return subprocess.run([str(program)], capture_output=True, text=True, check=True, timeout=10).stdout.split("\n")

    return run


RP2040 = """
uart_inst_t *const uart0;
void quadrature_start(uint32_t encoder, uint32_t first_pin) {}
int32_t quadrature_count(uint32_t encoder) { return 0; }
"""
ESP32 = "pcnt_unit_handle_t encoder_start(int side) { return NULL; }"
STM32 = """
static DMA_Stream_TypeDef stream;
static DMA_HandleTypeDef reception = {&stream};
static uint8_t *ring;
static uint16_t size;
TIM_HandleTypeDef htim1, htim2, htim3, htim4;
UART_HandleTypeDef huart2 = {HAL_UART_STATE_READY, &reception};
RNG_HandleTypeDef hrng;
IWDG_HandleTypeDef hiwdg;
GPIO_TypeDef *const stub_port;
HAL_StatusTypeDef HAL_UARTEx_ReceiveToIdle_DMA(UART_HandleTypeDef *uart, uint8_t *data, uint16_t count)
{
    ring = data;
    stream.NDTR = size = count;
    return HAL_OK;
}
static uint8_t next;
HAL_StatusTypeDef HAL_UART_Transmit_DMA(UART_HandleTypeDef *uart, const uint8_t *data, uint16_t count)
{
    for (int i = 0; i < 61; i++) {
        ring[size - stream.NDTR] = next++;
        stream.NDTR = (stream.NDTR > 1u) ? (stream.NDTR - 1u) : size;
    }
    return HAL_OK;
}
"""


def test_the_stm32_receives_whatever_it_sends_meanwhile(calls):
    """ST's HAL refuses what an interrupt asks of it while the main loop has it: so nothing is asked."""
    main = """
    uint8_t bytes[64], expected = 0u;
    (void)port_start(&config);
    for (int turn = 0; turn < 100; turn++) {
        (void)port_send(bytes, sizeof(bytes));
        const size_t count = port_receive(bytes, sizeof(bytes));
        if (count != 61u) { printf("%zu bytes\\n", count); }
        for (size_t i = 0u; i < count; i++) { if (bytes[i] != expected++) { puts("wrong"); } }
    }
    puts((port_receive(bytes, sizeof(bytes)) == 0u) ? "empty" : "more");
    """
    lines = calls("stm32", main, STM32)
    assert lines[-2:] == ["empty", ""]
    assert not {"wrong", *(line for line in lines if "bytes" in line)} & set(lines)


def test_the_rp2040s_watchdog_runs_on_in_the_debugger_and_takes_no_flashing_for_a_hang(calls):
    lines = calls("rp2040", "(void)port_start(&config);", RP2040)
    asked = [line for line in lines if line.startswith("watchdog")]
    assert asked == ["watchdog_enable_caused_reboot", "watchdog_enable 30 0"]


def test_the_esp32_sees_a_broken_wire_and_has_its_motors_pwm(calls):
    lines = calls("esp32", "(void)port_start(&config);", ESP32)
    assert "gpio_set_pull_mode 27 0" in lines, "the pull-up of the e-stop button"
    assert [line for line in lines if line.startswith("ledc")] == ["ledc_timer_config", *["ledc_channel_config"] * 2]
