// SPDX-License-Identifier: GPL-2.0
/*
 * hil-imu: an MPU-6500 as a register file, on a simulated I2C adapter and a simulated SPI controller at once.
 *
 * User space takes the part of the sensor: 14 bytes written at 0x3b of debugfs' hil-imu/regs are one sample (accelerometer,
 * temperature, gyro), which stands in the data registers and, once that is set up, in a FIFO of 512 bytes. Bus masters (i2c-dev,
 * spidev, or a stock IIO driver) read it back; a transaction is atomic against the writer.
 *
 *   whoami=0x70 i2c_addr=0x68
 *   bind=mpu6500 gpio_label=LABEL gpio_line=N  a stock driver on it, with the interrupt of that line (gpio-sim)
 *
 * debugfs hil-imu/: fail, short, broken (transactions to come that end with no acknowledge (I2C) or EIO (SPI), one message
 * short, and EIO), gone (all end with ENODEV while it is 1), lost (samples that met a full FIFO), transactions.
 * SPI frames: the first byte is the register, bit 7 set to read.
 */
#include <linux/module.h>
#include <linux/i2c.h>
#include <linux/spi/spi.h>
#include <linux/platform_device.h>
#include <linux/debugfs.h>
#include <linux/uaccess.h>
#include <linux/mutex.h>
#include <linux/gpio/driver.h>
#include <linux/gpio/consumer.h>
#include <linux/gpio/machine.h>
#include <linux/interrupt.h>

static ushort i2c_addr = 0x68;
module_param(i2c_addr, ushort, 0444);
static u8 whoami = 0x70;
module_param(whoami, byte, 0444);
static char *bind;
module_param(bind, charp, 0444);
static char *gpio_label;
module_param(gpio_label, charp, 0444);
static int gpio_line;
module_param(gpio_line, int, 0444);

enum { FIFO_EN = 0x23, INT_STATUS = 0x3a, DATA = 0x3b, USER_CTRL = 0x6a, PWR_MGMT_1 = 0x6b, COUNT = 0x72, FIFO = 0x74, WHO = 0x75 };
#define SAMPLE 14
#define FIFO_BYTES 512
#define OVERFLOW 0x10

static DEFINE_MUTEX(lock);
static u8 regs[256], fifo[FIFO_BYTES];
static u32 fifo_len, fail, shorten, broken, gone, lost, transactions;
static bool overflowed;
static u8 pointer;

static struct dentry *folder;
static struct platform_device *spi_host;
static struct i2c_client *client;
static struct gpio_desc *irq_line;

/* A sample as FIFO_EN wants it framed. */
static int framed(u8 *out, const u8 *sample)
{
	int n = 0;

	if (regs[FIFO_EN] & 0x08) {
		memcpy(out + n, sample, 6);
		n += 6;
	}
	if (regs[FIFO_EN] & 0x80) {
		memcpy(out + n, sample + 6, 2);
		n += 2;
	}
	if (regs[FIFO_EN] & 0x70) {
		memcpy(out + n, sample + 8, 6);
		n += 6;
	}
	return n;
}

static void take_sample(const u8 *sample)
{
	u8 frame[SAMPLE];
	int n = framed(frame, sample);

	regs[INT_STATUS] |= 1;
	if (!n || !(regs[USER_CTRL] & 0x40))
		return;
	if (fifo_len + n > FIFO_BYTES) {
		overflowed = true;
		lost++;
		return;
	}
	memcpy(fifo + fifo_len, frame, n);
	fifo_len += n;
}

static u8 fifo_pop(void)
{
	u8 byte = fifo[0];

	if (!fifo_len)
		return 0xff;
	memmove(fifo, fifo + 1, --fifo_len);
	return byte;
}

static u8 read_register(u8 a)
{
	u8 value;

	switch (a) {
	case COUNT:
		return fifo_len >> 8;
	case COUNT + 1:
		return fifo_len;
	case FIFO:
		return fifo_pop();
	case INT_STATUS:
		value = regs[a] | (overflowed ? OVERFLOW : 0);
		regs[a] = 0;
		overflowed = false;
		return value;
	default:
		return regs[a];
	}
}

static void write_register(u8 a, u8 value)
{
	if (a == PWR_MGMT_1 && value & 0x80) {
		memset(regs, 0, sizeof(regs));
		regs[WHO] = whoami;
		fifo_len = 0;
		value = 0x40;
	}
	if (a == USER_CTRL && value & 0x04) {
		fifo_len = 0;
		overflowed = false;
		value &= ~0x04;
	}
	regs[a] = value;
}

/* The FIFO's register is read again and again, every other the one after it next. */
static u8 next_register(u8 a)
{
	return a == FIFO ? a : a + 1;
}

static bool spend(u32 *budget)
{
	if (!*budget)
		return false;
	--*budget;
	return true;
}

static int i2c_transfer_all(struct i2c_adapter *adapter, struct i2c_msg *msgs, int n)
{
	int i, j, done = n;

	for (i = 0; i < n; i++)
		if (msgs[i].addr != i2c_addr)
			return -ENXIO;
	mutex_lock(&lock);
	transactions++;
	if (gone)
		done = -ENODEV;
	else if (spend(&fail))
		done = -ENXIO;
	else if (spend(&broken))
		done = -EIO;
	else if (spend(&shorten))
		done = n - 1;
	for (i = 0; i < done; i++) {
		if (msgs[i].flags & I2C_M_RD) {
			for (j = 0; j < msgs[i].len; j++, pointer = next_register(pointer))
				msgs[i].buf[j] = read_register(pointer);
		} else if (msgs[i].len) {
			pointer = msgs[i].buf[0];
			for (j = 1; j < msgs[i].len; j++, pointer = next_register(pointer))
				write_register(pointer, msgs[i].buf[j]);
		}
	}
	mutex_unlock(&lock);
	return done;
}

static u32 i2c_functions(struct i2c_adapter *adapter)
{
	return I2C_FUNC_I2C | I2C_FUNC_SMBUS_EMUL;
}

static const struct i2c_algorithm i2c_algorithm = { .master_xfer = i2c_transfer_all, .functionality = i2c_functions };
static struct i2c_adapter adapter = { .owner = THIS_MODULE, .algo = &i2c_algorithm, .name = "hil-imu i2c" };

static int spi_one_message(struct spi_controller *host, struct spi_message *message)
{
	struct spi_transfer *transfer;
	bool addressed = false, reading = false;
	u8 a = 0;
	u32 j;

	mutex_lock(&lock);
	transactions++;
	message->status = gone ? -ENODEV : spend(&fail) || spend(&broken) ? -EIO : 0;
	list_for_each_entry(transfer, &message->transfers, transfer_list) {
		const u8 *tx = transfer->tx_buf;
		u8 *rx = transfer->rx_buf;

		for (j = 0; !message->status && j < transfer->len; j++) {
			u8 out = tx ? tx[j] : 0, in = 0;

			if (!addressed) {
				reading = out & 0x80;
				a = out & 0x7f;
				addressed = true;
			} else {
				if (reading)
					in = read_register(a);
				else
					write_register(a, out);
				a = next_register(a);
			}
			if (rx)
				rx[j] = in;
		}
		if (!message->status)
			message->actual_length += transfer->len;
		if (transfer->cs_change && !list_is_last(&transfer->transfer_list, &message->transfers))
			addressed = false;
	}
	mutex_unlock(&lock);
	spi_finalize_current_message(host);
	return 0;
}

static ssize_t regs_read(struct file *file, char __user *buffer, size_t n, loff_t *at)
{
	ssize_t read;

	mutex_lock(&lock);
	read = simple_read_from_buffer(buffer, n, at, regs, sizeof(regs));
	mutex_unlock(&lock);
	return read;
}

static ssize_t regs_write(struct file *file, const char __user *buffer, size_t n, loff_t *at)
{
	u8 bytes[sizeof(regs)];

	if (*at < 0 || *at >= sizeof(regs))
		return -EINVAL;
	n = min_t(size_t, n, sizeof(regs) - *at);
	if (copy_from_user(bytes, buffer, n))
		return -EFAULT;
	mutex_lock(&lock);
	memcpy(regs + *at, bytes, n);
	if (*at == DATA && n >= SAMPLE)
		take_sample(bytes);
	mutex_unlock(&lock);
	*at += n;
	return n;
}

static const struct file_operations regs_operations = {
	.owner = THIS_MODULE,
	.read = regs_read,
	.write = regs_write,
	.llseek = default_llseek,
};

static int spi_probe(struct platform_device *device)
{
	struct spi_controller *host = devm_spi_alloc_master(&device->dev, 0);
	/* A device that spidev knows by name: /dev/spidevN.0. */
	struct spi_board_info info = { .modalias = "dh2228fv", .max_speed_hz = 10000000, .mode = SPI_MODE_0 };
	int failed;

	if (!host)
		return -ENOMEM;
	host->num_chipselect = 1;
	host->bus_num = -1;
	host->mode_bits = SPI_MODE_3;
	host->bits_per_word_mask = SPI_BPW_MASK(8);
	host->transfer_one_message = spi_one_message;
	failed = devm_spi_register_controller(&device->dev, host);
	if (!failed)
		spi_new_device(host, &info);
	return failed;
}

static struct platform_driver spi_driver = { .probe = spi_probe, .driver = { .name = "hil-imu-spi" } };

static int labelled(struct gpio_chip *chip, void *label)
{
	return chip->label && !strcmp(chip->label, label);
}

static void bind_stock_driver(void)
{
	struct i2c_board_info info = { .addr = i2c_addr };
	struct gpio_chip *chip = gpio_label ? gpiochip_find(gpio_label, labelled) : NULL;

	if (chip)
		irq_line = gpiochip_request_own_desc(chip, gpio_line, "hil-imu-int", GPIO_ACTIVE_HIGH, GPIOD_IN);
	if (!IS_ERR_OR_NULL(irq_line)) {
		info.irq = gpiod_to_irq(irq_line);
		irq_set_irq_type(info.irq, IRQ_TYPE_EDGE_RISING);
	}
	strscpy(info.type, bind, sizeof(info.type));
	client = i2c_new_client_device(&adapter, &info);
}

static int __init hil_imu_init(void)
{
	int failed;

	regs[WHO] = whoami;
	failed = i2c_add_adapter(&adapter);
	if (failed)
		return failed;
	failed = platform_driver_register(&spi_driver);
	if (failed)
		goto no_driver;
	spi_host = platform_device_register_simple("hil-imu-spi", -1, NULL, 0);
	if (IS_ERR(spi_host)) {
		failed = PTR_ERR(spi_host);
		goto no_host;
	}
	folder = debugfs_create_dir("hil-imu", NULL);
	debugfs_create_file("regs", 0600, folder, NULL, &regs_operations);
	debugfs_create_u32("fail", 0600, folder, &fail);
	debugfs_create_u32("short", 0600, folder, &shorten);
	debugfs_create_u32("broken", 0600, folder, &broken);
	debugfs_create_u32("gone", 0600, folder, &gone);
	debugfs_create_u32("lost", 0400, folder, &lost);
	debugfs_create_u32("transactions", 0400, folder, &transactions);
	if (bind)
		bind_stock_driver();
	return 0;
no_host:
	platform_driver_unregister(&spi_driver);
no_driver:
	i2c_del_adapter(&adapter);
	return failed;
}

static void __exit hil_imu_exit(void)
{
	if (!IS_ERR_OR_NULL(client))
		i2c_unregister_device(client);
	if (!IS_ERR_OR_NULL(irq_line))
		gpiochip_free_own_desc(irq_line);
	debugfs_remove_recursive(folder);
	platform_device_unregister(spi_host);
	platform_driver_unregister(&spi_driver);
	i2c_del_adapter(&adapter);
}

module_init(hil_imu_init);
module_exit(hil_imu_exit);
MODULE_LICENSE("GPL");
MODULE_DESCRIPTION("simulated MPU-6500 on I2C and SPI, for tests");
