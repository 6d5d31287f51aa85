// Plays a CSV of t_s,force_N to tormagd: homes, enables, publishes each row as its time comes.
//
//   apt install g++ libzmq3-dev cppzmq-dev libmsgpack-cxx-dev
//   g++ -std=c++17 -O2 publish.cpp -lzmq -o publish
//   ./publish FOLDER PROFILE.csv        FOLDER holds the daemon's sockets: /run/tormag, say
#include <chrono>
#include <cstdint>
#include <fstream>
#include <iostream>
#include <map>
#include <stdexcept>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include <msgpack.hpp>
#include <zmq.hpp>

using namespace std::chrono_literals;
using Clock = std::chrono::system_clock;
using Row = std::pair<double, double>;  // s, N

constexpr auto PATIENCE = 5s;        // for an answer of the daemon, and for its subscription
constexpr auto ARMING = 30s;         // homing takes some seconds
constexpr double VALID_FOR_MS = 500;  // then the force decays: nobody renders what a dead publisher last said

std::vector<Row> read_profile(const std::string& path) {
    std::ifstream file(path);
    std::string header;
    std::getline(file, header);
    if (header != "t_s,force_N") throw std::runtime_error(path + ": row 1 is '" + header + "', not t_s,force_N");
    std::vector<Row> rows;
    char comma;
    for (Row row; file >> row.first >> comma >> row.second;) rows.push_back(row);
    return rows;
}

// The refusal's code, "" where the command was carried out.
std::string request(zmq::socket_t& control, std::uint64_t id, const std::string& command, std::string& why) {
    msgpack::sbuffer out;
    msgpack::packer packer(out);
    packer.pack_map(4);
    packer.pack("v"), packer.pack(1);
    packer.pack("id"), packer.pack(id);
    packer.pack("command"), packer.pack(command);
    packer.pack("args"), packer.pack_map(0);
    control.send(zmq::buffer(out.data(), out.size()));
    zmq::message_t answer;
    if (!control.recv(answer)) throw std::runtime_error("no answer: is the daemon running?");
    const auto handle = msgpack::unpack(answer.data<char>(), answer.size());
    const auto reply = handle.get().as<std::map<std::string, msgpack::object>>();
    if (reply.at("ok").as<bool>()) return "";
    const auto error = reply.at("error").as<std::map<std::string, std::string>>();
    why = command + ": " + error.at("message") + "; " + error.at("hint");
    return error.at("code");
}

void arm(zmq::socket_t& control) {
    const auto until = Clock::now() + ARMING;
    std::uint64_t id = 0;
    for (const std::string command : {"home", "enable"}) {
        for (std::string why;; std::this_thread::sleep_for(100ms)) {
            const auto code = request(control, ++id, command, why);
            if (code.empty()) break;
            const bool passes = code == "busy" || code == "not_homed" || code == "not_fresh";
            if (!passes || Clock::now() > until) throw std::runtime_error(why);
        }
    }
}

void publish(zmq::socket_t& setpoints, std::uint64_t seq, std::int64_t session, Clock::time_point stamp, double force_N) {
    msgpack::sbuffer out;
    msgpack::packer packer(out);
    packer.pack_map(7);
    packer.pack("v"), packer.pack(1);
    packer.pack("source"), packer.pack("cpp");
    packer.pack("seq"), packer.pack(seq);
    packer.pack("session"), packer.pack(session);
    packer.pack("stamp_ns"), packer.pack(std::chrono::nanoseconds(stamp.time_since_epoch()).count());
    packer.pack("servo_cf"), packer.pack(force_N);
    packer.pack("valid_for_ms"), packer.pack(VALID_FOR_MS);
    setpoints.send(zmq::buffer(out.data(), out.size()));
}

int main(int count, char** arguments) try {
    if (count != 3) throw std::runtime_error("usage: publish FOLDER PROFILE.csv");
    const std::string folder = arguments[1];
    const auto rows = read_profile(arguments[2]);
    const int patience_ms = std::chrono::milliseconds(PATIENCE).count();

    zmq::context_t context;
    zmq::socket_t control(context, zmq::socket_type::dealer);
    control.set(zmq::sockopt::linger, 0);
    control.set(zmq::sockopt::rcvtimeo, patience_ms);
    control.connect("ipc://" + folder + "/control");
    arm(control);

    // XPUB speaks to the daemon's SUB as PUB does, and is told of its subscription: what is sent earlier is lost
    zmq::socket_t setpoints(context, zmq::socket_type::xpub);
    setpoints.set(zmq::sockopt::linger, 200);
    setpoints.set(zmq::sockopt::rcvtimeo, patience_ms);
    setpoints.connect("ipc://" + folder + "/setpoint");
    zmq::message_t subscription;
    if (!setpoints.recv(subscription)) throw std::runtime_error("nobody takes setpoints in " + folder);

    const auto start = Clock::now();
    const std::int64_t session = std::chrono::nanoseconds(start.time_since_epoch()).count();
    std::uint64_t seq = 0;
    for (const auto& [t_s, force_N] : rows) {
        const auto due = start + std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(t_s));
        std::this_thread::sleep_until(due);
        publish(setpoints, seq++, session, due, force_N);  // the stamp is when the force is meant, however late it is sent
    }
    std::cout << "published " << seq << " setpoints, the first meant for " << session << " ns since 1970\n";
    return 0;
} catch (const std::exception& error) {
    std::cerr << error.what() << "\n";
    return 1;
}
